// Resources of CUDA kernels provided by the caller: stream and memory. No CUDA header, so that the binding needs none.
#pragma once

#include <cstdint>

struct CUstream_st;  // what cudaStream_t points to

namespace pgccd {

// Device memory that is valid until the operator's work on the stream is done. The binding implements it by torch's
// allocator.
class DeviceMemory {
 public:
  virtual ~DeviceMemory() = default;
  virtual void* allocate_bytes(int64_t bytes) = 0;

  template <class T>
  T* allocate(int64_t count) {
    return static_cast<T*>(allocate_bytes(count * static_cast<int64_t>(sizeof(T))));
  }
};

struct DeviceContext {
  CUstream_st* stream;
  DeviceMemory& memory;
  // Above 1 where kernels of another stream run at the same time, and have more to do: kernels whose threads have items
  // in turn take 1/share of the blocks that the device holds, and none is launched before the previous one has ended.
  int share = 1;

  template <class T>
  T* allocate(int64_t count) const {
    return memory.allocate<T>(count);
  }
};

}  // namespace pgccd
