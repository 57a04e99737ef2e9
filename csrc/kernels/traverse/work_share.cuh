// Distributes the items of a launch over warps. Costs differ widely, so a warp takes more items when it runs out, and
// all warps end at about the same time.
#pragma once

#include "kernels/device.cuh"

namespace pgccd {

constexpr uint32_t kNoItem = ~0u;

struct WorkQueue {
  uint32_t* next;  // number of items taken from the queue: 0 at the start of the launch
  uint32_t count;  // items
  // A block ends after this many items of the queue, so that its multiprocessor can start another; kNoItem in a launch
  // whose blocks all run at the same time.
  uint32_t most_of_block;
};

// A warp's part of the queue. All members are called by whole warps.
class WorkShare {
 public:
  // The first items of each group are fixed, `groups_a_warp` for each warp of the launch: with few
  // items no warp waits for the queue. `taken_by_block` is shared memory of the block.
  __device__ WorkShare(const WorkQueue& queue, int groups_a_warp, uint32_t& taken_by_block)
      : queue_(queue), taken_by_block_(taken_by_block) {
    if (threadIdx.x == 0) taken_by_block_ = 0;
    __syncthreads();
    queued_from_ = gridDim.x * (blockDim.x / kWarp) * groups_a_warp;
    const bool is_one_wave = queue.most_of_block == kNoItem;
    give(warp_number(is_one_wave && queue.count <= queued_from_) * groups_a_warp, groups_a_warp);
  }

  // True if no items remain for this warp.
  __device__ bool is_over() const { return is_over_; }

  // Takes one of the next items for each of the lanes in `lanes`; kNoItem for some lanes if few are available: call
  // again.
  __device__ uint32_t take(uint32_t lanes, int lane) {
    if (begin_ == end_) refill();
    const uint32_t item = begin_ + __popc(lanes & lanes_below(lane)), end = end_;
    begin_ = smaller(end_, begin_ + __popc(lanes));
    return item < end ? item : kNoItem;
  }

 private:
  static constexpr uint32_t kAtATime = 8;

  __device__ void refill() {
    uint32_t first = queue_.count;
    if (queued_from_ < queue_.count) {
      if (threadIdx.x % kWarp == 0 && atomicAdd(&taken_by_block_, kAtATime) < queue_.most_of_block) {
        first = queued_from_ + atomicAdd(queue_.next, kAtATime);
      }
      first = __shfl_sync(kAllLanes, first, 0);
    }
    give(first, kAtATime);
    is_over_ = begin_ == end_;
  }
  __device__ void give(uint32_t first, uint32_t some) {
    begin_ = smaller(first, queue_.count);
    end_ = smaller(first + some, queue_.count);
  }

  const WorkQueue& queue_;
  uint32_t& taken_by_block_;
  uint32_t queued_from_ = 0, begin_ = 0, end_ = 0;
  bool is_over_ = false;
};

}  // namespace pgccd
