// Sums over the sample, by one block.
#pragma once

#include <cub/cub.cuh>

#include "kernels/broad/scene_sample.h"

namespace pgccd {

constexpr int kSampleThreads = 512;

// Storage in shared memory.
class BlockSample {
 public:
  // Calls look(box) for this thread's share.
  template <class Look>
  __device__ static void for_each(const BroadBodies& bodies, Look&& look) {
    const int64_t stride = sample_stride(bodies.count);
    for (int64_t b = threadIdx.x * stride; b < bodies.count; b += kSampleThreads * stride) {
      if (!bodies.is_absent(b)) look(swept_box(bodies, b));
    }
  }

  // Reductions over all threads, with the result on all threads; always in the same order.
  __device__ double sum(double own) { return shared(Reduce(scratch_).Sum(own)); }
  __device__ double maximum(double own) {
    return shared(Reduce(scratch_).Reduce(own, [](double a, double b) { return larger(a, b); }));
  }

 private:
  using Reduce = cub::BlockReduce<double, kSampleThreads>;

  __device__ double shared(double of_first_thread) {
    if (threadIdx.x == 0) result_ = of_first_thread;
    __syncthreads();
    const double result = result_;
    __syncthreads();
    return result;
  }

  typename Reduce::TempStorage scratch_;
  double result_;
};

}  // namespace pgccd
