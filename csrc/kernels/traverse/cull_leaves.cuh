// Rejects leaf pairs that certainly stay apart, and notes until when the others do. A thread tests one leaf pair at a
// time and then takes the next, so that all lanes of a warp have work although the number of steps differs.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/leaf_feature_item.h"
#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/task_queue.cuh"
#include "kernels/traverse/traverse.h"

namespace pgccd {

// Lowered to the earliest begin of the leaf pairs of each body pair that may meet, bits of a float; null if not needed.
using EarliestBegins = uint32_t*;

// Times are not negative, so their bits have the same order.
__device__ inline bool is_later(float time, unsigned long long latest) {
  return static_cast<unsigned long long>(__double_as_longlong(static_cast<double>(time))) > latest;
}

// Whether none of a leaf pair's candidates can come before what is known of its body pair.
template <class Bodies>
__device__ bool is_decided(const Pairs<Bodies>& pairs, const FirstPart& found, const LeafPair& item) {
  if (found.toi == nullptr) return false;
  const unsigned long long toi = found.toi[item.pair];
  if (toi == ~0ull) return false;
  if (found.any_will_do || is_later(item.begin, toi)) return true;
  if (toi != 0) return false;
  return found.known == nullptr ||
         first_feature_of(pairs.bodies, pairs.sweeps[item.pair].body, item.leaves) > found.known[item.pair];
}

// `found`: without times, nothing is known.
template <bool kDividesTime, class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    cull_leaves(Pairs<Bodies> pairs, LeafPairList leaves, LeafPairList meeting, EarliestBegins earliest,
                FirstPart found) {
  wait_for_previous_kernels();
  __shared__ WarpBuffer<LeafPair> buffers[kWarpsPerBlock];
  WarpBuffer<LeafPair>& buffer = buffers[threadIdx.x / kWarp];
  const int lane = threadIdx.x % kWarp;
  const auto put = [&](Counter at, const LeafPair& pair) { meeting.put(at, pair); };
  const uint32_t count = leaves.size(), warps = gridDim.x * kWarpsPerBlock;
  const uint32_t warp = warp_number(count <= warps * kWarp);
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
      is_busy = !is_over && !is_decided(pairs, found, item);
      k = 1;
      step = 0;
      free_part = 0.0f;
    }
    taken += __popc(idle);
    if (__ballot_sync(kAllLanes, !is_over) == 0) break;
    bool meets = false;
    if (is_busy) {
      const PairTree<Bodies> tree = pairs.tree(item.pair);
      bool is_turning = false;
      if constexpr (kDividesTime) {
        is_turning = tree.sweep().turns_fast();
        if (is_turning) {  // at once
          is_busy = false;
          item.begin =
              separation_detail::leaves_free_while_turning<float>(tree, item.leaves, {0, tree.sweep().segment_count});
          meets = item.begin != kNeverMeet;
        }
      }
      if (!is_turning) {
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
      if (meets && earliest != nullptr) atomicMin(earliest + item.pair, __float_as_uint(item.begin));
    }
    waiting = buffer.add(waiting, __ballot_sync(kAllLanes, meets), item, lane, meeting.count, put);
  }
  buffer.flush(waiting, lane, meeting.count, put);
}

// Whether a leaf pair, one of `count`, is among about kFirstLeaves of them: always the same ones.
__device__ inline bool is_sample(NodePair leaves, uint32_t count) {
  uint32_t mixed =
      static_cast<uint32_t>(leaves.first) * 0x9e3779b1u ^ static_cast<uint32_t>(leaves.second) * 0x85ebca77u;
  mixed = (mixed ^ mixed >> 15) * 0x2c1b3c6du;
  mixed = (mixed ^ mixed >> 12) * 0x297a2d39u;
  return __umulhi(mixed ^ mixed >> 15, count) < kFirstLeaves;
}

// Splits leaf pairs into those that begin first in their body pair, and the others. `counts`: of the first ones of each
// body pair: if there are many, a sample of them; null: all of them.
static __global__ void __launch_bounds__(kBlockThreads)
    split_by_begin(LeafPairList leaves, const uint32_t* earliest, const uint32_t* counts, LeafPairList first,
                   LeafPairList later) {
  wait_for_previous_kernels();
  __shared__ WarpBuffer<LeafPair> buffers[2][kWarpsPerBlock];
  const LeafPairList lists[2] = {later, first};
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const auto put = [&](int list) { return [&, list](Counter at, const LeafPair& item) { lists[list].put(at, item); }; };
  int waiting[2] = {0, 0};
  const uint32_t count = leaves.size(), stride = gridDim.x * blockDim.x;
  for (uint32_t begin = blockIdx.x * blockDim.x + threadIdx.x - lane; begin < count; begin += stride) {
    const bool is_given = lane < count - begin;
    const LeafPair item = is_given ? leaves.items[begin + lane] : LeafPair{};
    bool is_first = is_given && __float_as_uint(item.begin) == earliest[item.pair];
    if (is_first && counts != nullptr) is_first = is_sample(item.leaves, counts[item.pair]);
    for (int list = 0; list < 2; ++list) {
      const uint32_t lanes = __ballot_sync(kAllLanes, is_given && is_first == (list == 1));
      waiting[list] = buffers[list][warp].add(waiting[list], lanes, item, lane, lists[list].count, put(list));
    }
  }
  for (int list = 0; list < 2; ++list) {
    buffers[list][warp].flush(waiting[list], lane, lists[list].count, put(list));
  }
}

// Counts the leaf pairs of each body pair that begin first in it.
inline void count_first_leaves(const DeviceContext& context, LeafPairList leaves, const uint32_t* earliest,
                               uint32_t* counts) {
  for_each_counted(context, leaves.count, leaves.capacity, [=] __device__(int64_t row) {
    const LeafPair item = leaves.items[row];
    if (__float_as_uint(item.begin) == earliest[item.pair]) atomicAdd(counts + item.pair, 1u);
  });
}

}  // namespace pgccd
