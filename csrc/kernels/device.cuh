// Utilities of CUDA code: checked calls, copies, and what kernels share.
#pragma once

#include <cuda_runtime.h>

#include <cassert>
#include <cstdint>
#include <stdexcept>
#include <string>

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

// The versions, if the driver is too old for the CUDA runtime that is linked statically; torch's own may be older.
inline std::string versions_of(cudaError_t error) {
  if (error != cudaErrorInsufficientDriver) return "";
  int driver = 0;
  cudaDriverGetVersion(&driver);
  const auto text = [](int v) { return std::to_string(v / 1000) + "." + std::to_string(v % 1000 / 10); };
  return ": pgccd was built with CUDA " + text(CUDART_VERSION) + ", the driver of the GPU supports CUDA " +
         text(driver) + "; install a newer driver, or use tensors on the CPU";
}

inline void check_cuda(cudaError_t result, const char* what) {
  if (result != cudaSuccess)
    throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(result) + versions_of(result));
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

__device__ inline int64_t nanoseconds() {
  int64_t now;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
  return now;
}

// Whether all other blocks of the launch have also called this. Called by one thread of each block, after its last
// barrier.
__device__ inline bool is_last_block(uint32_t* blocks_done) {
  __threadfence();
  return atomicAdd(blocks_done, 1u) + 1 == gridDim.x;
}

// The number of this warp in the launch. If only warps with low numbers have items, these are the first warps of all
// blocks: a multiprocessor may hold many consecutive blocks.
__device__ inline uint32_t warp_number(bool has_few_items) {
  const uint32_t in_block = threadIdx.x / kWarp;
  return has_few_items ? in_block * gridDim.x + blockIdx.x : blockIdx.x * (blockDim.x / kWarp) + in_block;
}

__device__ inline uint32_t lanes_below(int lane) { return (1u << lane) - 1u; }

// Threads of a warp that append an item each to one list share one atomic. Returns this thread's index.
template <class Count>
__device__ Count warp_append(Count* counter) {
  const unsigned active = __activemask();
  const int lane = threadIdx.x % kWarp, leader = __ffs(active) - 1;
  Count base = 0;
  if (lane == leader) base = atomicAdd(counter, static_cast<Count>(__popc(active)));
  return __shfl_sync(active, base, leader) + __popc(active & lanes_below(lane));
}

// The same for `count` items each.
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
