#include <algorithm>
#include <numeric>
#include <vector>

#include "core/count_leading.h"
#include "kernels/broad/subdomain.h"
#include "kernels/find_rows.cuh"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Cells of a body are distributed over this many threads, since a large body reaches very many.
constexpr int kBodyThreads = 32;

// Leaving bodies are divided into shares, one per thread; limits of the number of shares, and of shares times ranks.
constexpr int64_t kMostShares = 4096, kMostSlots = int64_t{1} << 20;

__device__ void lower_to(int64_t* target, int64_t value) {
  if (*target > value) atomicMin(reinterpret_cast<long long*>(target), static_cast<long long>(value));
}

__device__ void raise_to(int64_t* target, int64_t value) {
  if (*target < value) atomicMax(reinterpret_cast<long long*>(target), static_cast<long long>(value));
}

// Number of nonzero rows of each column; one row of thread blocks per column.
__global__ void __launch_bounds__(kBlockThreads) count_columns(const uint8_t* table, int64_t rows, int64_t* counts) {
  wait_for_previous_kernels();
  using Reduce = cub::BlockReduce<int64_t, kBlockThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const int64_t columns = gridDim.y, column = blockIdx.y, stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  int64_t part = 0;
  for (int64_t row = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; row < rows; row += stride) {
    part += table[row * columns + column];
  }
  part = Reduce(storage).Sum(part);
  if (threadIdx.x == 0 && part != 0) {
    atomicAdd(reinterpret_cast<unsigned long long*>(counts + column), static_cast<unsigned long long>(part));
  }
}

struct IsReplicaRank {
  HeldRows held;
  // Items are ordered by (rank, row).
  __device__ bool operator()(int64_t item) const {
    return held.replica_ranks[(item % held.row_count) * held.ranks + item / held.row_count] != 0;
  }
};

struct Numbers {
  static constexpr int64_t kMost = 256;
  int64_t values[kMost];
};

// Copies host values to the device as kernel arguments, which a captured graph stores.
const int64_t* on_device(const DeviceContext& context, const std::vector<int64_t>& numbers) {
  const auto count = static_cast<int64_t>(numbers.size());
  int64_t* const there = context.allocate<int64_t>(count);
  for (int64_t begin = 0; begin < count; begin += Numbers::kMost) {
    const int64_t part = smaller(count - begin, Numbers::kMost);
    Numbers given{};
    std::copy_n(numbers.begin() + begin, part, given.values);
    for_each_item(context, part, [=] __device__(int64_t k) { there[begin + k] = given.values[k]; });
  }
  return there;
}

// End offsets of consecutive parts, on the device.
const int64_t* ends_of(const DeviceContext& context, std::vector<int64_t> sizes) {
  std::partial_sum(sizes.begin(), sizes.end(), sizes.begin());
  return on_device(context, sizes);
}

}  // namespace

void swept_boxes(const DeviceContext& context, const BroadBodies& bodies, double* lower, double* upper) {
  for_each_item(context, bodies.count, [=] __device__(int64_t body) { store_swept_box(bodies, body, lower, upper); });
}

void boundary_bodies(const DeviceContext& context, const BroadBodies& bodies, const Subdomain& subdomain,
                     uint8_t* reach, const FoundRows& boundary) {
  for_each_item(context, bodies.count,
                [=] __device__(int64_t body) { reach[body] = reaches_others(bodies, subdomain, body) ? 1 : 0; });
  fill_bytes(context, boundary.rows, 0xff, bodies.count);
  find_flagged(context, bodies.count, reach, boundary.rows, boundary.found);
}

void replica_ranks(const DeviceContext& context, const ReplicaRanksInput& input, const ReplicaRanks& out) {
  const BroadBodies bodies = input.bodies;
  const Subdomain subdomain = input.subdomain;
  const int64_t* rows = input.rows;
  const int64_t ranks = out.ranks;
  uint8_t* replica_ranks = out.replica_ranks;
  fill_bytes(context, replica_ranks, 0, input.row_count * ranks);
  fill_bytes(context, out.counts, 0, ranks);
  if (input.row_count == 0) return;
  const auto sources = static_cast<int64_t>(input.received.size());
  const int64_t* end = ends_of(context, input.received);
  for_each_item(context, kBodyThreads * input.row_count, [=] __device__(int64_t item) {
    const int64_t k = item / kBodyThreads, thread = item % kBodyThreads;
    if (rows[k] < 0) return;
    require_on_device(rows[k] < bodies.count, "bodies: expected -1 or rows of bodies");
    const auto mark = [&](int64_t rank) {
      require_on_device(is_within(rank, ranks), "owner: expected ranks");
      if (rank != subdomain.rank) replica_ranks[k * ranks + rank] = 1;
      return false;
    };
    subdomain.any_owner(swept_box(bodies, rows[k]), mark, thread, kBodyThreads);
    if (thread != 0 || sources == 0) return;
    int64_t source = 0;
    while (end[source] <= k) ++source;
    replica_ranks[k * ranks + source] = 1;
  });
  const int64_t blocks = smaller<int64_t>((input.row_count + kBlockThreads - 1) / kBlockThreads, 256);
  launch_kernel(context, count_columns, dim3(static_cast<unsigned>(blocks), static_cast<unsigned>(ranks)),
                kBlockThreads, replica_ranks, input.row_count, out.counts);
}

void reached_ranks(const DeviceContext& context, const ReachedRanks& input, int64_t* out) {
  for_each_item(context, input.row_count, [=] __device__(int64_t k) {
    require_on_device(is_within(input.rows[k], input.bodies.count), "bodies: expected rows of bodies");
    require_on_device(input.store(k, out), "begin: expected places for all ranks");
  });
}

void rows_by_rank(const DeviceContext& context, const HeldRows& held, const std::vector<int64_t>& capacities,
                  int64_t* by_rank) {
  const int64_t ranks = held.ranks, all = held.row_count * ranks;
  const int64_t places = std::accumulate(capacities.begin(), capacities.end(), int64_t{0});
  if (places == 0) return;
  int64_t* items = context.allocate<int64_t>(all);
  int64_t* found = context.allocate<int64_t>(1);
  find_rows(context, all, items, found, IsReplicaRank{held});
  const int64_t* capacity_end = ends_of(context, capacities);
  int64_t* begin = context.allocate<int64_t>(ranks);
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, held.counts, begin, ranks, context.stream);
  });
  for_each_item(context, places, [=] __device__(int64_t place) {
    const int64_t rank = count_leading(ranks, [&](int64_t r) { return capacity_end[r] <= place; });
    const int64_t k = place - (rank == 0 ? 0 : capacity_end[rank - 1]);
    const bool is_held = k < held.counts[rank];
    require_on_device(!is_held || is_within(begin[rank] + k, *found), "counts: expected those of replica_ranks");
    by_rank[place] = is_held ? held.rows[items[begin[rank] + k] % held.row_count] : -1;
  });
}

void counts_to_send(const DeviceContext& context, const CapacityInput& input, const std::vector<int64_t>& capacities,
                    int64_t* messages) {
  const int64_t ranks = static_cast<int64_t>(capacities.size());
  const int64_t* const capacity = on_device(context, capacities);
  for_each_item(context, ranks, [=] __device__(int64_t rank) {
    messages[2 * rank] = input.counts[rank];
    messages[2 * rank + 1] = input.is_short(capacity, ranks) ? 1 : 0;
  });
}

void owned_pairs(const DeviceContext& context, const OwnedPairs& input, int64_t* owned, int64_t* found) {
  int64_t* kept = context.allocate<int64_t>(input.pair_count);
  find_rows(context, input.pair_count, kept, found, [=] __device__(int64_t k) {
    require_on_device(is_sound(input, k), "pairs, rows: expected padding, or bodies held");
    return is_owned(input, k);
  });
  for_each_item(context, input.pair_count,
                [=] __device__(int64_t k) { store_owned_pair(input, kept, *found, k, owned); });
}

void near_ghosts(const DeviceContext& context, const BroadBodies& bodies, const uint8_t* reach,
                 const BroadBodies& ghosts, const Subdomain& subdomain, const FoundRows& near) {
  const CellRows rows(subdomain.frame);
  const int64_t numbers = 6 * rows.size();
  int64_t* cell_boxes = context.allocate<int64_t>(numbers);
  for_each_item(context, numbers,
                [=] __device__(int64_t at) { cell_boxes[at] = at % 6 < 3 ? kEmptyLower : kEmptyUpper; });
  for_each_item(context, kBodyThreads * ghosts.count, [=] __device__(int64_t item) {
    if (ghosts.is_absent(item / kBodyThreads)) return;
    const SweptBox box = swept_box(ghosts, item / kBodyThreads);
    const CellRange range(subdomain.frame, box);
    int64_t corners[6];
    ordered_corners(box, corners);
    const int64_t count = range.count();
    for (int64_t k = item % kBodyThreads; k < count; k += kBodyThreads) {
      if (!subdomain.has_cell(subdomain.frame.index(range[k]))) continue;
      int64_t* const around = cell_boxes + 6 * rows.row(range[k]);
      for (int axis = 0; axis < 3; ++axis) {
        lower_to(around + axis, corners[axis]);
        raise_to(around + 3 + axis, corners[3 + axis]);
      }
    }
  });
  const CellFrame frame = subdomain.frame;
  find_rows(context, bodies.count, near.rows, near.found,
            [=] __device__(int64_t body) { return is_near(bodies, reach, frame, cell_boxes, body); });
}

void leaving_bodies(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                    int64_t ranks, const LeavingRows& leaving) {
  const int64_t most_shares = larger<int64_t>(1, smaller(kMostShares, kMostSlots / ranks));
  const int64_t shares = smaller(bodies.count, most_shares), slots = ranks * shares;
  if (slots == 0) return fill_bytes(context, leaving.counts, 0, ranks);
  int64_t* found = context.allocate<int64_t>(1);
  find_rows(context, bodies.count, leaving.rows, found, [=] __device__(int64_t body) {
    require_on_device(is_within(owner_of(subdomain, bodies, body), ranks), "owner: expected ranks");
    return is_leaving(subdomain, bodies, body);
  });
  // A counting sort, since the count is on the device only. Each share is processed in order, so rows to one rank stay
  // in order. next (ranks, shares): index of a share's next row to a rank.
  int64_t* next = context.allocate<int64_t>(slots);
  const int64_t* rows = leaving.rows;
  for_each_item(context, shares, [=] __device__(int64_t share) {
    for (int64_t rank = 0; rank < ranks; ++rank) next[rank * shares + share] = 0;
    const int64_t begin = *found * share / shares, end = *found * (share + 1) / shares;
    for (int64_t k = begin; k < end; ++k) {
      ++next[owner_of(subdomain, bodies, rows[k]) * shares + share];
    }
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, next, next, slots, context.stream);
  });
  int64_t* counts = leaving.counts;
  for_each_item(context, ranks, [=] __device__(int64_t rank) {
    counts[rank] = (rank + 1 < ranks ? next[(rank + 1) * shares] : *found) - next[rank * shares];
  });
  int64_t* by_destination = leaving.by_destination;
  for_each_item(context, shares, [=] __device__(int64_t share) {
    const int64_t begin = *found * share / shares, end = *found * (share + 1) / shares;
    for (int64_t k = begin; k < end; ++k) {
      by_destination[next[owner_of(subdomain, bodies, rows[k]) * shares + share]++] = rows[k];
    }
  });
}

void leaving_and_invalid(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                         int64_t* counts) {
  fill_bytes(context, counts, 0, 2);
  for_each_item(context, bodies.count, [=] __device__(int64_t body) {
    if (is_leaving(subdomain, bodies, body)) warp_append(reinterpret_cast<unsigned long long*>(counts));
    if (has_invalid_position(bodies, body)) warp_append(reinterpret_cast<unsigned long long*>(counts + 1));
  });
}

}  // namespace pgccd
