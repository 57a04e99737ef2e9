// Distribution of a launch's items over its warps.
#pragma once

#include "kernels/device.cuh"

namespace pgccd {

// The items that this warp takes: `lanes` at a time, from `begin` on.
struct WarpShare {
  uint32_t begin, stride, lanes;
};

// With fewer items than threads, each warp takes fewer than 32 at a time, so that all warps have some, and fewer lanes
// wait for others in different branches.
__device__ inline WarpShare share_of_warp(uint32_t count) {
  const uint32_t warps = gridDim.x * (blockDim.x / kWarp);
  const uint32_t warp = (blockIdx.x * blockDim.x + threadIdx.x) / kWarp;
  const uint32_t lanes = count >= warps * kWarp ? uint32_t{kWarp} : larger<uint32_t>(1, (count + warps - 1) / warps);
  return {warp * lanes, warps * lanes, lanes};
}

// Shared memory of a warp: items that wait until there is one for each lane.
using WaitingItems = uint32_t[2 * kWarp];

// Calls fn(item) for the items in [begin, end) for which is_selected(item). A warp collects them, so that its lanes are
// full although few are selected. Called by whole warps.
template <class Select, class Fn>
__device__ void for_each_selected(uint32_t begin, uint32_t end, WaitingItems& waiting, Select&& is_selected, Fn&& fn) {
  const uint32_t lane = threadIdx.x % kWarp;
  const WarpShare share = share_of_warp(end - begin);
  uint32_t collected = 0;
  for (uint32_t base = begin + share.begin;; base += share.stride) {
    const bool is_last = base >= end;  // then the remaining ones are due
    if (!is_last) {
      const uint32_t item = base + lane;
      const bool selected = lane < share.lanes && item < end && is_selected(item);
      const uint32_t lanes = __ballot_sync(kAllLanes, selected);
      if (selected) waiting[collected + __popc(lanes & lanes_below(lane))] = item;
      collected += __popc(lanes);
      if (collected < kWarp) continue;
    }
    __syncwarp();
    const uint32_t some = smaller<uint32_t>(collected, kWarp);
    collected -= some;
    const uint32_t mine = lane < some ? waiting[collected + lane] : 0u;
    __syncwarp();  // before other lanes overwrite them
    if (lane < some) fn(mine);
    if (is_last) return;
  }
}

}  // namespace pgccd
