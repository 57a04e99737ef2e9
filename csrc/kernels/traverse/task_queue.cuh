// Work lists of the traversal on the device. Lists also count items beyond their capacity, so that the host can read
// the capacity needed.
#pragma once

#include "core/candidate.h"
#include "kernels/device.cuh"
#include "kernels/traverse/pair_item.h"

namespace pgccd {

// A pair of nodes that may meet, one of which has children.
struct alignas(16) Task {
  int32_t pair;
  SplitPair split;
};

template <class T>
struct DeviceList {
  T* items;
  Counter* count;
  uint32_t capacity;

  __device__ uint32_t size() const { return fits(*count, capacity) ? static_cast<uint32_t>(*count) : capacity; }
  __device__ void put(Counter at, const T& item) const {
    if (has_place(at, capacity)) items[at] = item;
  }
};

using LeafPairList = DeviceList<LeafPair>;
using TaskList = DeviceList<Task>;

// Tasks passed from one launch to the next. Three counters rotate, so that none needs a launch to reset it: one is
// read, one is written, and one is reset for the next launch; likewise the number of tasks taken.
struct TaskHandover {
  TaskList from, to;
  uint32_t* taken;
  Counter* next_count;
  uint32_t* next_taken;
  Counter* most;  // largest number of tasks passed on at once

  __device__ void prepare_next() const {
    if (blockIdx.x != 0 || threadIdx.x != 0) return;
    *next_count = 0;
    *next_taken = 0;
    *most = larger(*most, *from.count);
  }
};

// Candidates of one kind side by side, so that a warp of the narrow phase finds one kind of work: edge pairs fill the
// list from its start, vertex-face pairs from its end.
struct CandidateSink {
  Candidate* items;
  CandidateCounts* counts;
  uint32_t capacity;

  // On overflow the two ends overwrite each other; the counts show it.
  __device__ void put(bool is_edge_edge, Counter at, const Candidate& candidate) const {
    if (has_place(at, capacity)) items[is_edge_edge ? at : capacity - 1 - at] = candidate;
  }
};

// Each body pair has this many poses in rows of its own, which suffice if it rotates little in a step.
constexpr int kPosesAtHand = 2;

// All body pairs in their local frames.
template <class Bodies>
struct Pairs {
  using Sweep = SweepOf<Bodies>;
  Bodies bodies;
  const Sweep* sweeps;
  const LocalPose* poses;      // the first poses of all pairs; then all poses of those with more
  const uint32_t* pose_begin;  // first row of all poses of a pair
  const int64_t* given_count;  // on the device
  int64_t most;                // rows given; no more are counted
  const Counter* pose_count;   // of pairs with more; on the device, as the next
  const Counter* unsound;
  uint32_t pose_capacity;

  // Zero where poses did not fit (the traversal is repeated with a larger capacity) or a row has invalid indices.
  __device__ uint32_t count() const {
    if (!fits(*pose_count, pose_capacity) || *unsound != 0) return 0;
    return static_cast<uint32_t>(given());
  }
  __device__ int64_t given() const { return smaller(larger<int64_t>(*given_count, 0), most); }
  __device__ const LocalPose* first_poses(int32_t pair) const { return poses + int64_t{kPosesAtHand} * pair; }
  __device__ const LocalPose* all_poses(int32_t pair) const { return poses + pose_begin[pair]; }
  __device__ PairTree<Bodies> tree(int32_t pair) const { return {bodies, sweeps[pair], all_poses(pair)}; }
};

// One atomic for all lanes whose bit is set; returns the position of the first.
__device__ inline Counter reserve(Counter* count, uint32_t wanted, int lane) {
  Counter first = 0;
  if (lane == 0 && wanted != 0) first = atomicAdd(count, static_cast<Counter>(wanted));
  return __shfl_sync(kAllLanes, first, 0);
}

// A warp's buffer of items for a list: appended many at a time, since every append is an atomic on the same word. All
// members are called by whole warps.
template <class T>
struct WarpBuffer {
  static constexpr int kFlushAt = 64;
  T items[kFlushAt + kWarp];

  // Adds the items of the lanes in `lanes`. Returns the number of buffered items; `put` and `count` are those of the
  // list.
  template <class Put>
  __device__ int add(int waiting, uint32_t lanes, const T& item, int lane, Counter* count, Put&& put) {
    if (lanes >> lane & 1u) items[waiting + __popc(lanes & lanes_below(lane))] = item;
    waiting += __popc(lanes);
    return waiting >= kFlushAt ? flush(waiting, lane, count, put) : waiting;
  }
  template <class Put>
  __device__ int flush(int waiting, int lane, Counter* count, Put&& put) {
    if (waiting == 0) return 0;
    __syncwarp();
    const Counter first = reserve(count, static_cast<uint32_t>(waiting), lane);
    for (int k = lane; k < waiting; k += kWarp) put(first + k, items[k]);
    __syncwarp();
    return 0;
  }
};

}  // namespace pgccd
