#include <cub/cub.cuh>

#include "core/bits.h"
#include "kernels/broad/pair_list.cuh"

namespace pgccd {
namespace {

// A row of at most so many pairs is sorted by one thread.
constexpr uint32_t kLongestShortRow = 32;

struct PairCounts {
  unsigned long long candidates, pairs;
  unsigned has_long_row;
};

// The pairs found, and how many there are with each i; a pair's rank is its place among those.
struct RankedPairs {
  PairList list;
  uint32_t* rank;
  uint32_t* row_counts;
  unsigned* has_long_row;
};

__global__ void __launch_bounds__(kBlockThreads)
    keep_colliding(BroadBodies bodies, PairList candidates, RankedPairs out) {
  __shared__ PairBuffer buffer;
  buffer.clear();
  const int64_t listed = smaller(static_cast<int64_t>(*candidates.count), candidates.capacity);
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  // All threads of a block make the same number of rounds; the buffer holds what one round can add.
  for (int64_t first = static_cast<int64_t>(blockIdx.x) * blockDim.x; first < listed; first += stride) {
    const int64_t k = first + threadIdx.x;
    if (k < listed) {
      const uint64_t pair = candidates.pairs[k];
      if (is_potentially_colliding(bodies, first_of(pair), second_of(pair))) buffer.append(out.list, pair);
    }
    buffer.flush(out.list, [&](int64_t position, uint64_t pair) {
      const uint32_t rank = atomicAdd(&out.row_counts[first_of(pair)], 1u);
      out.rank[position] = rank;
      if (rank == kLongestShortRow) *out.has_long_row = 1u;
    });
  }
}

__device__ void write_row(int64_t* out, int64_t row, int64_t i, int64_t j) {
  out[2 * row] = i;
  out[2 * row + 1] = j;
}

// Counting sort by i, then each row by itself: the pairs pass through memory twice.
void write_short_rows(const DeviceContext& context, const RankedPairs& found, int64_t count, const uint32_t* row_begin,
                      int64_t body_count, int64_t* out) {
  int32_t* second = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    const uint64_t pair = found.list.pairs[k];
    second[row_begin[first_of(pair)] + found.rank[k]] = second_of(pair);
  });
  for_each_item(context, body_count, [=] __device__(int64_t i) {
    const int64_t begin = row_begin[i], end = row_begin[i + 1];
    for (int64_t at = begin + 1; at < end; ++at) {
      const int32_t value = second[at];
      int64_t place = at;
      for (; place > begin && second[place - 1] > value; --place) second[place] = second[place - 1];
      second[place] = value;
    }
    for (int64_t row = begin; row < end; ++row) write_row(out, row, i, second[row]);
  });
}

void write_by_radix_sort(const DeviceContext& context, const uint64_t* pairs, int64_t count, int64_t body_count,
                         int64_t* out) {
  const int bits = bit_width(static_cast<uint64_t>(body_count));
  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted = context.allocate<uint64_t>(count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    keys[k] = (static_cast<uint64_t>(first_of(pairs[k])) << bits) | static_cast<uint64_t>(second_of(pairs[k]));
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortKeys(scratch, bytes, keys, sorted, count, 0, 2 * bits, context.stream);
  });
  const uint64_t low = (uint64_t{1} << bits) - 1;
  for_each_item(context, count, [=] __device__(int64_t row) {
    write_row(out, row, static_cast<int64_t>(sorted[row] >> bits), static_cast<int64_t>(sorted[row] & low));
  });
}

}  // namespace

void collect_pairs(const DeviceContext& context, const BroadBodies& bodies, const PairOutput& make_output,
                   const CandidateLaunch& launch) {
  const int64_t body_count = bodies.count;
  auto* counts = context.allocate<PairCounts>(1);
  uint32_t* row_counts = context.allocate<uint32_t>(body_count + 1);
  uint32_t* row_begin = context.allocate<uint32_t>(body_count + 1);
  int64_t candidate_capacity = 6 * body_count + 1024, pair_capacity = 4 * body_count + 1024;
  RankedPairs found;
  PairCounts totals;
  for (;;) {
    const PairList candidates{&counts->candidates, context.allocate<uint64_t>(candidate_capacity), candidate_capacity};
    found = {{&counts->pairs, context.allocate<uint64_t>(pair_capacity), pair_capacity},
             context.allocate<uint32_t>(pair_capacity),
             row_counts,
             &counts->has_long_row};
    fill_bytes(context, counts, 0, 1);
    fill_bytes(context, row_counts, 0, body_count + 1);
    launch(candidates);
    check_cuda(cudaGetLastError(), "broad phase");
    keep_colliding<<<resident_blocks(16), kBlockThreads, 0, context.stream>>>(bodies, candidates, found);
    check_cuda(cudaGetLastError(), "broad phase");
    run_cub(context, [&](void* scratch, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(scratch, bytes, row_counts, row_begin, body_count + 1, context.stream);
    });
    totals = read(context, counts);
    const auto fits = [](unsigned long long count, int64_t capacity) {
      return static_cast<int64_t>(count) <= capacity;
    };
    if (fits(totals.candidates, candidate_capacity) && fits(totals.pairs, pair_capacity)) break;
    candidate_capacity = pair_capacity = static_cast<int64_t>(totals.candidates);
  }
  const int64_t count = static_cast<int64_t>(totals.pairs);
  int64_t* out = make_output(count);
  if (count == 0) return;
  const bool positions_fit = (totals.pairs >> 32) == 0;
  if (totals.has_long_row == 0 && positions_fit) {
    write_short_rows(context, found, count, row_begin, body_count, out);
  } else {
    write_by_radix_sort(context, found.list.pairs, count, body_count, out);
  }
}

}  // namespace pgccd
