// Reductions over the sample, by one block.
#pragma once

#include "kernels/broad/scene_sample.h"
#include "kernels/device.cuh"

namespace pgccd {

constexpr int kSampleThreads = 512;

// Storage in shared memory.
class BlockSample {
 public:
  // Calls look(box) for this thread's share.
  template <class Look>
  __device__ static void for_each(const BroadBodies& bodies, Look&& look) {
    for_each_sampled(bodies, look, threadIdx.x, kSampleThreads);
  }

  // Reduce each value over all threads, always in the same order; all threads get the results.
  template <int kCount>
  __device__ void sum(double (&own)[kCount]) {
    reduce(own, [](double a, double b) { return a + b; });
  }
  template <int kCount>
  __device__ void maximum(double (&own)[kCount]) {
    reduce(own, [](double a, double b) { return larger(a, b); });
  }

 private:
  static constexpr int kMostValues = 6, kWarps = kSampleThreads / kWarp;

  template <int kCount, class Combine>
  __device__ void reduce(double (&own)[kCount], Combine&& combine) {
    static_assert(kCount <= kMostValues);
    for (int step = kWarp / 2; step > 0; step /= 2) {
      for (double& value : own) value = combine(value, __shfl_xor_sync(kAllLanes, value, step));
    }
    if (threadIdx.x % kWarp == 0) {
      for (int k = 0; k < kCount; ++k) of_warp_[threadIdx.x / kWarp][k] = own[k];
    }
    __syncthreads();
    // One thread for each value: all threads together would take longer.
    if (const int k = threadIdx.x; k < kCount) {
      double all = of_warp_[0][k];
      for (int warp = 1; warp < kWarps; ++warp) all = combine(all, of_warp_[warp][k]);
      of_warp_[0][k] = all;
    }
    __syncthreads();
    for (int k = 0; k < kCount; ++k) own[k] = of_warp_[0][k];
    __syncthreads();  // before the storage is reused
  }

  double of_warp_[kWarps][kMostValues];
};

}  // namespace pgccd
