// Launches of kernels on the context's stream.
#pragma once

#include <cstdint>
#include <map>
#include <utility>

#include "kernels/device.cuh"

namespace pgccd {

// The first statement of every kernel: waits until all kernels launched before have ended, and meanwhile lets the next
// one be launched, whose blocks wait here as well. Hides most of a launch's latency (programmatic dependent launch),
// unless the kernel takes only a share of the device.
__device__ inline void wait_for_previous_kernels() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  cudaTriggerProgrammaticLaunchCompletion();
  cudaGridDependencySynchronize();
#endif
}

inline int current_device() {
  int device = 0;
  check_cuda(cudaGetDevice(&device), "cudaGetDevice");
  return device;
}

namespace device_detail {

// Whether kernels wait for previous ones by themselves. All are compiled for the same architectures.
inline bool do_kernels_wait(const void* kernel) {
  thread_local std::map<int, bool> known;  // by device
  const auto [found, is_new] = known.try_emplace(current_device());
  if (is_new) {
    cudaFuncAttributes attributes{};
    check_cuda(cudaFuncGetAttributes(&attributes, kernel), "cudaFuncGetAttributes");
    found->second = attributes.ptxVersion >= 90;
  }
  return found->second;
}

}  // namespace device_detail

template <class... Parameters, class... Arguments>
void launch_kernel(const DeviceContext& context, void (*kernel)(Parameters...), dim3 blocks, int block_threads,
                   const Arguments&... arguments) {
  cudaLaunchAttribute overlap{};
  overlap.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  overlap.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = blocks;
  config.blockDim = dim3(static_cast<unsigned>(block_threads));
  config.stream = context.stream;
  config.attrs = &overlap;
  // Waiting blocks would take the places of blocks of other streams.
  const bool may_wait = context.share == 1 && device_detail::do_kernels_wait(reinterpret_cast<const void*>(kernel));
  config.numAttrs = may_wait ? 1 : 0;
  check_cuda(cudaLaunchKernelEx(&config, kernel, arguments...), "cudaLaunchKernelEx");
}

namespace device_detail {

template <class Fn>
__global__ void __launch_bounds__(kBlockThreads) for_each_kernel(int64_t count, Fn fn) {
  wait_for_previous_kernels();
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t item = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; item < count; item += stride)
    fn(item);
}

}  // namespace device_detail

// Runs fn(item) for every item in [0, count).
template <class Fn>
void for_each_item(const DeviceContext& context, int64_t count, Fn fn) {
  if (count <= 0) return;
  const int64_t blocks = (count + kBlockThreads - 1) / kBlockThreads;
  constexpr int64_t kMostBlocks = int64_t{1} << 20;
  launch_kernel(context, device_detail::for_each_kernel<Fn>, static_cast<unsigned>(smaller(blocks, kMostBlocks)),
                kBlockThreads, count, fn);
}

// Sets every byte.
template <class T>
void fill_bytes(const DeviceContext& context, T* target, int value, int64_t count) {
  // In a CUDA graph a memset is launched when the kernel before it has ended, and the next kernel when the memset has
  // ended: 1.3 us on an H200. Launches of kernels overlap, see `wait_for_previous_kernels`: 0.8 us.
  constexpr int64_t kFewBytes = 1 << 20;
  const int64_t bytes = count * static_cast<int64_t>(sizeof(T));
  if (bytes == 0) return;  // adds no node to a CUDA graph
  if constexpr (sizeof(T) % sizeof(uint32_t) == 0 && alignof(T) % alignof(uint32_t) == 0) {
    if (bytes <= kFewBytes) {
      auto* const words = reinterpret_cast<uint32_t*>(target);
      const uint32_t word = 0x01010101u * static_cast<uint8_t>(value);
      return for_each_item(context, bytes / static_cast<int64_t>(sizeof(uint32_t)),
                           [=] __device__(int64_t k) { words[k] = word; });
    }
  }
  check_cuda(cudaMemsetAsync(target, value, bytes, context.stream), "cudaMemsetAsync");
}

inline int resident_blocks(const DeviceContext& context, int blocks_a_multiprocessor) {
  int multiprocessors = 0;
  check_cuda(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, current_device()),
             "cudaDeviceGetAttribute");
  return larger(multiprocessors * blocks_a_multiprocessor / context.share, 1);
}

// The number of blocks with a thread for each item.
inline unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kBlockThreads - 1) / kBlockThreads); }

// The number of blocks whose threads have items in turn: as many as the device takes at a time, or fewer for few items.
inline unsigned looping_blocks_for(const DeviceContext& context, int64_t items, int most_a_multiprocessor = 16) {
  const int64_t blocks = larger<int64_t>(blocks_for(items), 1);
  return static_cast<unsigned>(smaller<int64_t>(blocks, resident_blocks(context, most_a_multiprocessor)));
}

// The number of blocks that the device holds at once, or the context's share of it; for kernels whose amount of work is
// only known on the device.
template <class Kernel>
int resident_blocks_of(const DeviceContext& context, Kernel kernel, int block_threads = kBlockThreads) {
  // Cached: the query takes longer than a launch.
  thread_local std::map<std::pair<Kernel, int>, int> known;
  int& a_multiprocessor = known[{kernel, current_device()}];
  if (a_multiprocessor == 0) {
    check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&a_multiprocessor, kernel, block_threads, 0),
               "cudaOccupancyMaxActiveBlocksPerMultiprocessor");
  }
  return resident_blocks(context, larger(a_multiprocessor, 1));
}

namespace device_detail {

template <class Count, class Fn>
__global__ void __launch_bounds__(kBlockThreads) for_each_counted_kernel(const Count* count, int64_t most, Fn fn) {
  wait_for_previous_kernels();
  const int64_t counted = static_cast<int64_t>(*count), end = counted < most ? counted : most;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t item = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; item < end; item += stride) fn(item);
}

}  // namespace device_detail

// Runs fn(item) for every item in [0, *count), a count in device memory, but at most `most` items.
template <class Count, class Fn>
void for_each_counted(const DeviceContext& context, const Count* count, int64_t most, Fn fn) {
  if (most <= 0) return;
  launch_kernel(context, device_detail::for_each_counted_kernel<Count, Fn>, looping_blocks_for(context, most, 8),
                kBlockThreads, count, most, fn);
}

// Records the time at this point of the stream.
inline void note_time(const DeviceContext& context, int64_t* time) {
  for_each_item(context, 1, [=] __device__(int64_t) { *time = nanoseconds(); });
}

}  // namespace pgccd
