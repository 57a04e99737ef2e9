// Utilities of CUDA launches: checked calls, one stream, few synchronisations.
#pragma once

#include <cuda_runtime.h>

#include <cassert>
#include <cstdint>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>

#include "core/scalar.h"
#include "kernels/device_context.h"

#if defined(NDEBUG)  // otherwise declared by <cassert>
extern "C" {
#if defined(__CUDA_ARCH__)
__host__ __device__
#endif
    void __assert_fail(const char* assertion, const char* file, unsigned int line, const char* function) noexcept
    __attribute__((__noreturn__));
}
#endif

namespace pgccd {

inline void check_cuda(cudaError_t result, const char* what) {
  if (result != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(result));
}

template <class T>
void copy(const DeviceContext& context, const T* source, int64_t count, T* target) {
  if (count == 0) return;  // adds no node to a CUDA graph
  check_cuda(cudaMemcpyAsync(target, source, count * sizeof(T), cudaMemcpyDeviceToDevice, context.stream),
             "cudaMemcpyAsync");
}

// Reads a value. Synchronises the stream: only for sizes needed on the host.
template <class T>
T read(const DeviceContext& context, const T* source) {
  T value;
  check_cuda(cudaMemcpyAsync(&value, source, sizeof(T), cudaMemcpyDeviceToHost, context.stream), "cudaMemcpyAsync");
  check_cuda(cudaStreamSynchronize(context.stream), "cudaStreamSynchronize");
  return value;
}

// cub's two-call protocol: query the scratch size, then run.
template <class Call>
void run_cub(const DeviceContext& context, Call&& call) {
  size_t bytes = 0;
  check_cuda(call(nullptr, bytes), "cub (size)");
  void* scratch = context.memory.allocate_bytes(static_cast<int64_t>(bytes));
  check_cuda(call(scratch, bytes), "cub");
}

// An assertion that stays in release builds, for indices that the host never reads: the kernel fails, as torch's own
// do, before it reads through them.
__device__ inline void require_on_device(bool is_so, const char* what) {
  if (!is_so) __assert_fail(what, __FILE__, __LINE__, "pgccd");
}

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = ~0u;
constexpr int kBlockThreads = 128;
constexpr int kWarpsPerBlock = kBlockThreads / kWarp;

namespace device_detail {

template <class Fn>
__global__ void __launch_bounds__(kBlockThreads) for_each_kernel(int64_t count, Fn fn) {
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
  device_detail::for_each_kernel<<<static_cast<unsigned>(blocks < kMostBlocks ? blocks : kMostBlocks), kBlockThreads, 0,
                                   context.stream>>>(count, fn);
  check_cuda(cudaGetLastError(), "kernel launch");
}

// Sets every byte.
template <class T>
void fill_bytes(const DeviceContext& context, T* target, int value, int64_t count) {
  // In a CUDA graph a small memset takes 7 us, a kernel less than 2.
  constexpr int64_t kFewBytes = 4096;
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

inline int current_device() {
  int device = 0;
  check_cuda(cudaGetDevice(&device), "cudaGetDevice");
  return device;
}

inline int resident_blocks(int blocks_a_multiprocessor) {
  int multiprocessors = 0;
  check_cuda(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, current_device()),
             "cudaDeviceGetAttribute");
  return multiprocessors * blocks_a_multiprocessor;
}

// The number of blocks that the device holds at once; for kernels whose amount of work is only known on the device.
template <class Kernel>
int resident_blocks_of(Kernel kernel, int block_threads = kBlockThreads) {
  // Cached: the query takes longer than a launch.
  thread_local std::map<std::pair<Kernel, int>, int> known;
  int& found = known[{kernel, current_device()}];
  if (found > 0) return found;
  int blocks = 0;
  check_cuda(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, block_threads, 0),
             "cudaOccupancyMaxActiveBlocksPerMultiprocessor");
  return found = resident_blocks(larger(blocks, 1));
}

namespace device_detail {

template <class Count, class Fn>
__global__ void __launch_bounds__(kBlockThreads) for_each_counted_kernel(const Count* count, int64_t most, Fn fn) {
  const int64_t counted = static_cast<int64_t>(*count), end = counted < most ? counted : most;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t item = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; item < end; item += stride) fn(item);
}

}  // namespace device_detail

// Runs fn(item) for every item in [0, *count), a count in device memory, but at most `most` items.
template <class Count, class Fn>
void for_each_counted(const DeviceContext& context, const Count* count, int64_t most, Fn fn) {
  if (most <= 0) return;
  const int64_t blocks = smaller<int64_t>(resident_blocks(8), (most + kBlockThreads - 1) / kBlockThreads);
  device_detail::for_each_counted_kernel<<<static_cast<unsigned>(blocks), kBlockThreads, 0, context.stream>>>(count,
                                                                                                              most, fn);
  check_cuda(cudaGetLastError(), "kernel launch");
}

__device__ inline int64_t nanoseconds() {
  int64_t now;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
  return now;
}

// Records the time at this point of the stream.
inline void note_time(const DeviceContext& context, int64_t* time) {
  for_each_item(context, 1, [=] __device__(int64_t) { *time = nanoseconds(); });
}

// Whether all other blocks of the launch have also called this. Called by one thread of each block, after its last
// barrier.
__device__ inline bool is_last_block(uint32_t* blocks_done) {
  __threadfence();
  return atomicAdd(blocks_done, 1u) + 1 == gridDim.x;
}

__device__ inline uint32_t lanes_below(int lane) { return (1u << lane) - 1u; }

// Threads of a warp that append to one list share one atomic. Returns this thread's index.
template <class Count>
__device__ Count warp_append(Count* counter, uint32_t count) {
  const unsigned active = __activemask();
  const int lane = threadIdx.x % kWarp;
  uint32_t before = 0, total = 0;
  for (unsigned rest = active; rest != 0; rest &= rest - 1) {
    const int source = __ffs(rest) - 1;
    const uint32_t other = __shfl_sync(active, count, source);
    if (source < lane) before += other;
    total += other;
  }
  Count base = 0;
  const int leader = __ffs(active) - 1;
  if (lane == leader && total != 0) base = atomicAdd(counter, static_cast<Count>(total));
  return __shfl_sync(active, base, leader) + before;
}

}  // namespace pgccd
