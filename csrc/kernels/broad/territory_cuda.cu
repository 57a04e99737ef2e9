#include "kernels/broad/territory_cuda.h"
#include "kernels/find_rows.cuh"

namespace pgccd {
namespace {

// Cells of a body are dealt out to so many threads: a large one reaches very many.
constexpr int kBodyThreads = 32;

// Into which bodies that leave are divided, each for one thread.
constexpr int64_t kMostShares = 4096;

__device__ void lower_to(int64_t* target, int64_t value) {
  if (*target > value) atomicMin(reinterpret_cast<long long*>(target), static_cast<long long>(value));
}

__device__ void raise_to(int64_t* target, int64_t value) {
  if (*target < value) atomicMax(reinterpret_cast<long long*>(target), static_cast<long long>(value));
}

}  // namespace

void border_bodies_cuda(const DeviceContext& context, const BroadBodies& bodies, const Territory& territory,
                        uint8_t* reach, const FoundRows& border) {
  for_each_item(context, bodies.count, [=] __device__(int64_t body) {
    reach[body] = reaches_others(bodies, territory, body) ? kReachesOthers : 0;
  });
  find_rows(context, bodies.count, border.rows, border.found,
            [=] __device__(int64_t body) { return reach[body] != 0; });
}

void reached_ranks_cuda(const DeviceContext& context, const BroadBodies& bodies, const Territory& territory,
                        const int64_t* rows, int64_t row_count, int64_t ranks, uint8_t* reached) {
  fill_bytes(context, reached, 0, row_count * ranks);
  for_each_item(context, kBodyThreads * row_count, [=] __device__(int64_t item) {
    const int64_t row = item / kBodyThreads;
    const CellRange range(territory.frame, swept_box(bodies, rows[row]));
    const int64_t count = range.count();
    for (int64_t k = item % kBodyThreads; k < count; k += kBodyThreads) {
      reached[row * ranks + territory.owner[territory.frame.index(range[k])]] = 1;
    }
  });
}

void owned_pairs_cuda(const DeviceContext& context, const OwnedPairs& input, int64_t pair_count,
                      const FoundRows& owned) {
  find_rows(context, pair_count, owned.rows, owned.found,
            [=] __device__(int64_t pair) { return is_owned(input, pair); });
}

void near_ghosts_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadBodies& ghosts,
                      const Territory& territory, const FoundRows& near) {
  const int64_t numbers = 6 * territory.frame.cell_count();
  int64_t* cell_boxes = context.allocate<int64_t>(numbers);
  for_each_item(context, numbers,
                [=] __device__(int64_t at) { cell_boxes[at] = at % 6 < 3 ? kEmptyLower : kEmptyUpper; });
  for_each_item(context, kBodyThreads * ghosts.count, [=] __device__(int64_t item) {
    const SweptBox box = swept_box(ghosts, item / kBodyThreads);
    const CellRange range(territory.frame, box);
    int64_t corners[6];
    ordered_corners(box, corners);
    const int64_t count = range.count();
    for (int64_t k = item % kBodyThreads; k < count; k += kBodyThreads) {
      const int64_t cell = territory.frame.index(range[k]);
      if (territory.owner[cell] != territory.rank) continue;
      for (int axis = 0; axis < 3; ++axis) {
        lower_to(cell_boxes + 6 * cell + axis, corners[axis]);
        raise_to(cell_boxes + 6 * cell + 3 + axis, corners[3 + axis]);
      }
    }
  });
  const CellFrame frame = territory.frame;
  find_rows(context, bodies.count, near.rows, near.found,
            [=] __device__(int64_t body) { return is_near(bodies, frame, cell_boxes, body); });
}

void leaving_bodies_cuda(const DeviceContext& context, const double* position, int64_t count,
                         const Territory& territory, int64_t ranks, const LeavingRows& leaving) {
  const int64_t shares = smaller(count, kMostShares), slots = ranks * shares;
  if (slots == 0) return fill_bytes(context, leaving.counts, 0, ranks);
  int64_t* found = context.allocate<int64_t>(1);
  find_rows(context, count, leaving.rows, found,
            [=] __device__(int64_t body) { return owner_of(territory, position, body) != territory.rank; });
  // A counting sort, since the device alone knows how many there are. Each share goes through its rows in order, so
  // that those to one rank stay in order. next (ranks, shares): where a share's next row to a rank comes.
  int64_t* next = context.allocate<int64_t>(slots);
  const int64_t* rows = leaving.rows;
  for_each_item(context, shares, [=] __device__(int64_t share) {
    for (int64_t rank = 0; rank < ranks; ++rank) next[rank * shares + share] = 0;
    const int64_t begin = *found * share / shares, end = *found * (share + 1) / shares;
    for (int64_t k = begin; k < end; ++k) {
      ++next[owner_of(territory, position, rows[k]) * shares + share];
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
      by_destination[next[owner_of(territory, position, rows[k]) * shares + share]++] = rows[k];
    }
  });
}

}  // namespace pgccd
