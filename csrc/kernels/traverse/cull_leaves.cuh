// Rejects leaf pairs that certainly stay apart, and notes until when the others do. A thread tests one leaf pair at a
// time and then takes the next, so that all lanes of a warp have work although the number of steps differs.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/task_queue.cuh"

namespace pgccd {

// Times of each body pair, as bits; null if they are not needed.
struct PairTimes {
  uint32_t* earliest;                // lowered to the earliest begin of its leaf pairs that may meet, a float
  const unsigned long long* latest;  // leaf pairs that begin later are rejected; all ones, or a double
};

// Times are not negative, so their bits have the same order.
__device__ inline bool is_later(float time, unsigned long long latest) {
  return static_cast<unsigned long long>(__double_as_longlong(static_cast<double>(time))) > latest;
}

template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    cull_leaves(Pairs<Bodies> pairs, LeafPairList leaves, LeafPairList meeting, PairTimes times) {
  wait_for_previous_kernels();
  __shared__ WarpBuffer<LeafPair> buffers[kWarpsPerBlock];
  WarpBuffer<LeafPair>& buffer = buffers[threadIdx.x / kWarp];
  const int lane = threadIdx.x % kWarp;
  const auto put = [&](Counter at, const LeafPair& pair) { meeting.put(at, pair); };
  const uint32_t count = leaves.size(), warps = gridDim.x * kWarpsPerBlock;
  const uint32_t warp = (blockIdx.x * blockDim.x + threadIdx.x) / kWarp;
  uint32_t taken = 0;  // by the warp, 32 consecutive items at a time
  int waiting = 0;
  LeafPair item{};
  bool is_busy = false, is_over = false;
  int k = 0, step = 0;
  Vec3<float> reached{};
  float free_part = 0.0f;
  for (;;) {
    const uint32_t idle = __ballot_sync(kAllLanes, !is_busy);
    if (!is_busy) {
      const uint32_t place = taken + __popc(idle & lanes_below(lane));
      const uint64_t row = (uint64_t{place / kWarp} * warps + warp) * kWarp + place % kWarp;
      is_over = row >= count;
      if (!is_over) item = leaves.items[row];
      is_busy = !is_over && (times.latest == nullptr || !is_later(item.begin, times.latest[item.pair]));
      k = 1;
      step = 0;
      free_part = 0.0f;
    }
    taken += __popc(idle);
    if (__ballot_sync(kAllLanes, !is_over) == 0) break;
    bool meets = false;
    if (is_busy) {
      const PairTree<Bodies> tree = pairs.tree(item.pair);
      if (tree.sweep().turns_fast()) {  // at once: few pairs do
        is_busy = false;
        item.begin =
            separation_detail::leaves_free_while_turning<float>(tree, item.leaves, {0, tree.sweep().segment_count});
        meets = item.begin != kNeverMeet;
      } else {
        const LeafSeparation<float, Bodies> separation(tree, item.leaves, k);
        if (step == 0) reached = separation.between_spheres();
        ++step;
        if (separation.is_along(reached, free_part)) {
          is_busy = k < tree.sweep().segment_count;
          ++k;
          step = 0;
          free_part = 0.0f;
        } else if (step == kSeparationSteps) {
          is_busy = false;
          meets = true;
          item.begin = separation.free_until(free_part);
        }
      }
      if (meets && times.earliest != nullptr) atomicMin(times.earliest + item.pair, __float_as_uint(item.begin));
    }
    waiting = buffer.add(waiting, __ballot_sync(kAllLanes, meets), item, lane, meeting.count, put);
  }
  buffer.flush(waiting, lane, meeting.count, put);
}

// Splits leaf pairs into those that begin first in their body pair, and the others.
inline void split_by_begin(const DeviceContext& context, LeafPairList leaves, const uint32_t* earliest,
                           LeafPairList first, LeafPairList later) {
  for_each_counted(context, leaves.count, leaves.capacity, [=] __device__(int64_t row) {
    const LeafPair item = leaves.items[row];
    const bool is_first = __float_as_uint(item.begin) == earliest[item.pair];
    const Counter at_first = warp_append(first.count, is_first ? 1u : 0u);
    const Counter at_later = warp_append(later.count, is_first ? 0u : 1u);
    is_first ? first.put(at_first, item) : later.put(at_later, item);
  });
}

}  // namespace pgccd
