#include <cub/cub.cuh>

#include "core/bits.h"
#include "kernels/broad/pair_list.cuh"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Rows of at most this many pairs are sorted by one thread.
constexpr uint32_t kLongestShortRow = 32;

struct PairCounts {
  unsigned long long overlaps, pairs;
  unsigned has_long_row;
};

// The pairs found, and their number for each i; a pair's rank is its place among those.
struct RankedPairs {
  PairList list;
  uint32_t* rank;
  uint32_t* row_counts;
  unsigned* has_long_row;
};

template <bool kMayHaveBoxes>
__global__ void __launch_bounds__(kBlockThreads)
    keep_colliding(BroadBodies bodies, PairList candidates, RankedPairs out) {
  wait_for_previous_kernels();
  __shared__ PairBuffer buffer;
  buffer.clear();
  const int64_t listed = smaller(static_cast<int64_t>(*candidates.count), candidates.capacity);
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  // All threads of a block run the same number of rounds; the buffer holds the pairs of one round.
  for (int64_t first = static_cast<int64_t>(blockIdx.x) * blockDim.x; first < listed; first += stride) {
    const int64_t k = first + threadIdx.x;
    if (k < listed) {
      const uint64_t pair = candidates.pairs[k];
      if (is_potentially_colliding<kMayHaveBoxes>(bodies, first_of(pair), second_of(pair)))
        buffer.append(out.list, pair);
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

// The pairs found, on the device.
struct Found {
  RankedPairs ranked;
  PairCounts* counts;
  const uint32_t* row_begin;
};

// Counting sort by i, then a sort of each row: two passes through memory. Long rows are not sorted.
void write_by_rows(const DeviceContext& context, const Found& found, int64_t capacity, int64_t body_count,
                   int64_t* out) {
  int32_t* second = context.allocate<int32_t>(capacity);
  const RankedPairs ranked = found.ranked;
  const uint32_t* row_begin = found.row_begin;
  const unsigned* has_long_row = &found.counts->has_long_row;
  for_each_counted(context, &found.counts->pairs, capacity, [=] __device__(int64_t k) {
    const uint64_t pair = ranked.list.pairs[k];
    second[row_begin[first_of(pair)] + ranked.rank[k]] = second_of(pair);
  });
  for_each_item(context, body_count, [=] __device__(int64_t i) {
    if (*has_long_row != 0) return;
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

void write_by_radix_sort(const DeviceContext& context, const Found& found, int64_t capacity, int64_t body_count,
                         int64_t* out) {
  const int bits = bit_width(static_cast<uint64_t>(body_count));
  const uint64_t low = (uint64_t{1} << bits) - 1;
  uint64_t* keys = context.allocate<uint64_t>(capacity);
  uint64_t* sorted = context.allocate<uint64_t>(capacity);
  const uint64_t* pairs = found.ranked.list.pairs;
  const unsigned long long* count = &found.counts->pairs;
  for_each_item(context, capacity, [=] __device__(int64_t k) {
    if (k >= static_cast<int64_t>(*count)) {
      keys[k] = ~uint64_t{0};  // after all others
      return;
    }
    keys[k] = (static_cast<uint64_t>(first_of(pairs[k])) << bits) | static_cast<uint64_t>(second_of(pairs[k]));
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortKeys(scratch, bytes, keys, sorted, capacity, 0, 2 * bits, context.stream);
  });
  for_each_counted(context, count, capacity, [=] __device__(int64_t row) {
    write_row(out, row, static_cast<int64_t>(sorted[row] >> bits), static_cast<int64_t>(sorted[row] & low));
  });
}

Found list_pairs(const DeviceContext& context, const BroadBodies& bodies, const PairCapacity& capacity,
                 const CandidateLaunch& launch) {
  auto* counts = context.allocate<PairCounts>(1);
  uint32_t* row_counts = context.allocate<uint32_t>(bodies.count + 1);
  uint32_t* row_begin = context.allocate<uint32_t>(bodies.count + 1);
  const PairList candidates{&counts->overlaps, context.allocate<uint64_t>(capacity.overlaps), capacity.overlaps,
                            bodies.is_invalid};
  const Found found{{{&counts->pairs, context.allocate<uint64_t>(capacity.pairs), capacity.pairs},
                     context.allocate<uint32_t>(capacity.pairs),
                     row_counts,
                     &counts->has_long_row},
                    counts,
                    row_begin};
  fill_bytes(context, counts, 0, 1);
  fill_bytes(context, row_counts, 0, bodies.count + 1);
  launch(candidates);
  check_cuda(cudaGetLastError(), "broad phase");
  const auto keep = bodies.boxes == nullptr ? keep_colliding<false> : keep_colliding<true>;
  launch_kernel(context, keep, looping_blocks_for(context, capacity.overlaps), kBlockThreads, bodies, candidates,
                found.ranked);
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, row_counts, row_begin, bodies.count + 1, context.stream);
  });
  return found;
}

void write_pairs(const DeviceContext& context, const Found& found, int64_t capacity, bool long_rows, int64_t body_count,
                 int64_t* out) {
  if (long_rows) {
    write_by_radix_sort(context, found, capacity, body_count, out);
  } else {
    write_by_rows(context, found, capacity, body_count, out);
  }
}

void collect_exactly(const DeviceContext& context, const BroadBodies& bodies, const PairOutput& make_output,
                     const CandidateLaunch& launch) {
  PairCapacity capacity{4 * bodies.count + 1024, 6 * bodies.count + 1024, false};
  for (;;) {
    const Found found = list_pairs(context, bodies, capacity, launch);
    const PairCounts seen = read(context, found.counts);
    const int64_t count = static_cast<int64_t>(seen.pairs), overlaps = static_cast<int64_t>(seen.overlaps);
    if (overlaps > capacity.overlaps || count > capacity.pairs) {
      capacity.overlaps = capacity.pairs = overlaps;
      continue;
    }
    int64_t* out = make_output(count);
    const bool positions_fit = (seen.pairs >> 32) == 0;
    if (count > 0) write_pairs(context, found, count, seen.has_long_row != 0 || !positions_fit, bodies.count, out);
    return;
  }
}

void collect_padded(const DeviceContext& context, const BroadBodies& bodies, const PaddedPairs& out,
                    const CandidateLaunch& launch) {
  const Found found = list_pairs(context, bodies, out.capacity, launch);
  const PairCounts* seen = found.counts;
  const PairCapacity capacity = out.capacity;
  int64_t *rows = out.rows, *counts = out.counts;
  // Counts, and padding behind the rows that are written below.
  for_each_item(context, larger<int64_t>(1, capacity.pairs), [=] __device__(int64_t row) {
    const int64_t pairs = static_cast<int64_t>(seen->pairs), overlaps = static_cast<int64_t>(seen->overlaps);
    const bool is_written = seen->has_long_row == 0 || capacity.long_rows;
    const int64_t written = is_written ? smaller(pairs, capacity.pairs) : 0;
    if (row >= written && row < capacity.pairs) write_row(rows, row, -1, -1);
    if (row != 0) return;
    counts[kPairsNeeded] = pairs;
    counts[kOverlapsNeeded] = overlaps;
    counts[kLongRowsNeeded] = seen->has_long_row;
    counts[kPairsWritten] = written;
    const bool fits = pairs <= capacity.pairs && overlaps <= capacity.overlaps;
    counts[kPairsOverflow] = fits && is_written ? 0 : 1;
  });
  write_pairs(context, found, out.capacity.pairs, out.capacity.long_rows, bodies.count, out.rows);
  note_time(context, out.counts + kBroadEnded);
}

}  // namespace

void collect_pairs(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out,
                   const CandidateLaunch& launch) {
  if (const auto* padded = std::get_if<PaddedPairs>(&out)) {
    collect_padded(context, bodies, *padded, launch);
  } else {
    collect_exactly(context, bodies, std::get<PairOutput>(out), launch);
  }
}

void note_beginning(const DeviceContext& context, const PairSink& out) {
  if (const auto* padded = std::get_if<PaddedPairs>(&out)) note_time(context, padded->counts + kBroadBegan);
}

void write_no_pairs(const DeviceContext& context, const PairSink& out) {
  if (const auto* padded = std::get_if<PaddedPairs>(&out)) {
    fill_bytes(context, padded->rows, 0xff, 2 * padded->capacity.pairs);
    fill_bytes(context, padded->counts, 0, kPairCounts);
  } else {
    std::get<PairOutput>(out)(0);
  }
}

}  // namespace pgccd
