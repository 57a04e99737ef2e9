// From body pairs to the first tasks of the descent: the sweep, the poses and the first split of each pair.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/start_self_pairs.cuh"
#include "kernels/traverse/support_item.h"
#include "kernels/traverse/words.cuh"

namespace pgccd {

// What a launch writes, one row per pair; poses as in `Pairs`.
template <class Bodies>
struct PlacedPairs {
  SweepOf<Bodies>* sweeps;
  LocalPose* poses;
  uint32_t* pose_begin;
  TaskList roots;       // of pairs whose roots may meet and have children
  LeafPairList leaves;  // roots without children
  SelfPairs self_pairs;
};

// Memory of a warp: rows of all lanes, padded by a word so that lanes use different banks.
template <class Sweep>
union StagedRows {
  uint4 sweeps[kWarp][kWordsOf<Sweep> + 1];
  uint4 poses[kWarp][kPosesAtHand * kWordsOf<LocalPose> + 1];
};

// Stores the rows of the lanes in `lanes`, consecutive ones of one structure each, neighbouring threads neighbouring
// words: stores of whole rows by single threads take twice as long.
template <int kWords, class T>
__device__ void store_rows(const uint4 (&staged)[kWarp][kWords], uint32_t lanes, T* target) {
  constexpr int kStored = kWords - 1;
  __syncwarp();
  auto* words = reinterpret_cast<uint4*>(target);
  for (int k = threadIdx.x % kWarp; k < kWarp * kStored; k += kWarp) {
    if (lanes >> (k / kStored) & 1u) words[k] = staged[k / kStored][k % kStored];
  }
  __syncwarp();  // before the memory is written again
}

// One thread per pair. How many poses a pair needs depends on how far its bodies turn. Pairs whose roots stay apart
// leave nothing to later launches.
template <bool kDividesTime, class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    place_pairs(Pairs<Bodies> pairs, TraverseInput input, PlacedPairs<Bodies> out, TraverseCounters* counters) {
  wait_for_previous_kernels();
  using Sweep = SweepOf<Bodies>;
  __shared__ StagedRows<Sweep> all_staged[kWarpsPerBlock];
  __shared__ WarpBuffer<Task> buffers[kWarpsPerBlock];
  StagedRows<Sweep>& staged = all_staged[threadIdx.x / kWarp];
  WarpBuffer<Task>& buffer = buffers[threadIdx.x / kWarp];
  const auto put_root = [&](Counter at, const Task& task) { out.roots.put(at, task); };
  int waiting = 0;
  const Bodies& bodies = pairs.bodies;
  const int lane = threadIdx.x % kWarp;
  const int64_t count = pairs.given(), stride = int64_t{gridDim.x} * blockDim.x;
  const auto own_poses = static_cast<uint32_t>(kPosesAtHand * pairs.most);
  for (int64_t first = (int64_t{blockIdx.x} * blockDim.x + threadIdx.x) / kWarp * kWarp; first < count;
       first += stride) {
    const int rows = static_cast<int>(smaller<int64_t>(count - first, kWarp));
    const int64_t pair = first + smaller(lane, rows - 1);  // the last lanes repeat a row, and do not store it
    const int64_t i = input.pairs[2 * pair], j = input.pairs[2 * pair + 1];
    const bool is_unsound = !is_sound(bodies, i) || !is_sound(bodies, j);
    if (__any_sync(kAllLanes, is_unsound)) {
      counters->unsound = 1;  // then no pairs are searched
      continue;
    }
    const Sweep sweep(bodies, i, j, input.settings, horizon_of(input, pair));
    PGCCD_KEEP_LOOP
    for (int k = 0; k < kPosesAtHand; ++k) {
      put_words(sweep.pose(bodies, k), staged.poses[lane] + k * kWordsOf<LocalPose>);
    }
    const auto row = static_cast<int32_t>(pair);
    uint32_t begin = static_cast<uint32_t>(kPosesAtHand * pair);
    const auto* poses = reinterpret_cast<const LocalPose*>(staged.poses[lane]);
    bool is_needed = false, has_task = false;
    Task task{row, SplitPair::none()};
    if (lane < rows) {
      if (sweep.segment_count >= kStoredSegments) counters->has_fast_pairs = 1;
      if (sweep.last_pose() >= kPosesAtHand) {
        const Counter place = warp_append(&counters->poses, static_cast<uint32_t>(sweep.segment_count) + 1u);
        // Clamp to valid rows; the overflow flag discards the result.
        const bool has_rows = has_place(place + sweep.segment_count, pairs.pose_capacity);
        begin = own_poses + (has_rows ? static_cast<uint32_t>(place) : 0u);
        for (int k = 0; k <= sweep.segment_count; ++k) store_words(sweep.pose(bodies, k), out.poses[begin + k]);
        poses = out.poses + begin;
      }
      out.self_pairs.add_if_one_body(bodies, sweep, row);
      is_needed = sweep.is_one_body();
      if (!is_needed) {
        const PairTree<Bodies> tree(bodies, sweep, poses);
        const NodePair nodes{0, 0};
        is_needed = roots_may_meet<kDividesTime>(tree);
        has_task = is_needed && !tree.is_leaf_pair(nodes);
        if (is_needed && !has_task) out.leaves.put(warp_append(out.leaves.count), {row, nodes});
        if (has_task) task.split = tree.split(nodes);
      }
      if (is_needed) out.pose_begin[pair] = begin;
    }
    const uint32_t needed = __ballot_sync(kAllLanes, is_needed);
    store_rows(staged.poses, needed, out.poses + kPosesAtHand * first);
    put_words(sweep, staged.sweeps[lane]);
    store_rows(staged.sweeps, needed, out.sweeps + first);
    waiting = buffer.add(waiting, __ballot_sync(kAllLanes, has_task), task, lane, out.roots.count, put_root);
  }
  buffer.flush(waiting, lane, out.roots.count, put_root);
}

}  // namespace pgccd
