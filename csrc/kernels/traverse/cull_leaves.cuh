// Rejects leaf pairs of the descent that certainly stay apart. A thread tests one leaf pair at a time and then takes
// the next, so that all lanes of a warp have work although the number of steps differs.
#pragma once

#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/task_queue.cuh"

namespace pgccd {

template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    cull_leaves(Pairs<Bodies> pairs, LeafPairList leaves, LeafPairList meeting) {
  __shared__ WarpBuffer<LeafPair> buffers[kWarpsPerBlock];
  WarpBuffer<LeafPair>& buffer = buffers[threadIdx.x / kWarp];
  const int lane = threadIdx.x % kWarp;
  const auto put = [&](Counter at, const LeafPair& pair) { meeting.put(at, pair); };
  const uint32_t count = leaves.size(), warps = gridDim.x * kWarpsPerBlock;
  const uint32_t warp = (blockIdx.x * blockDim.x + threadIdx.x) / kWarp;
  uint32_t taken = 0;  // by the warp, 32 consecutive items at a time
  int waiting = 0;
  LeafPair item{};
  bool is_busy = false;
  int k = 0, step = 0;
  Vec3<float> reached{};
  for (;;) {
    const uint32_t idle = __ballot_sync(kAllLanes, !is_busy);
    if (!is_busy) {
      const uint32_t place = taken + __popc(idle & lanes_below(lane));
      const uint64_t row = (uint64_t{place / kWarp} * warps + warp) * kWarp + place % kWarp;
      is_busy = row < count;
      if (is_busy) item = leaves.items[row];
      k = 1;
      step = 0;
    }
    taken += __popc(idle);
    if (__ballot_sync(kAllLanes, is_busy) == 0) break;
    bool meets = false;
    if (is_busy) {
      const PairTree<Bodies> tree = pairs.tree(item.pair);
      const LeafSeparation<float, Bodies> separation(tree, item.leaves, k);
      if (step == 0) reached = separation.between_spheres();
      ++step;
      if (separation.is_along(reached)) {
        is_busy = k < tree.sweep().segment_count;
        ++k;
        step = 0;
      } else if (step == kSeparationSteps) {
        is_busy = false;
        meets = true;
      }
    }
    waiting = buffer.add(waiting, __ballot_sync(kAllLanes, meets), item, lane, meeting.count, put);
  }
  buffer.flush(waiting, lane, meeting.count, put);
}

}  // namespace pgccd
