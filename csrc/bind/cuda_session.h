// What an operator on a CUDA device runs on: the tensor's device, torch's current stream, memory of its allocator.
#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <vector>

#include "bind/outputs.h"
#include "bind/thread_state.h"
#include "kernels/device_context.h"

// Null in a torch without CUDA, which can load this library too.
#pragma weak aoti_torch_get_current_cuda_stream

namespace pgccd::bind {

// Freed with the operator: torch's allocator is stream-ordered, so memory used by kernels in flight is not reused
// before they end.
class TorchMemory final : public DeviceMemory {
 public:
  explicit TorchMemory(const torch::stable::Tensor& like) : like_(like) {}

  // Small allocations share a block: a call of torch's allocator takes as long as a kernel launch.
  void* allocate_bytes(int64_t bytes) override {
    const int64_t aligned = (std::max<int64_t>(bytes, 1) + kAlignment - 1) / kAlignment * kAlignment;
    if (aligned > kBlockBytes / 4) return static_cast<void*>(new_block(aligned));
    if (aligned > left_) {
      next_ = new_block(kBlockBytes);
      left_ = kBlockBytes;
    }
    char* const piece = next_;
    next_ += aligned;
    left_ -= aligned;
    return piece;
  }

 private:
  static constexpr int64_t kAlignment = 256, kBlockBytes = int64_t{4} << 20;

  char* new_block(int64_t bytes) {
    held_.push_back(new_empty(like_, {bytes}, ScalarType::Byte, bytes));
    held_bytes_ += bytes;
    scratch_peak() = std::max(scratch_peak(), held_bytes_);
    return static_cast<char*>(held_.back().data_ptr());
  }

  torch::stable::Tensor like_;
  std::vector<torch::stable::Tensor> held_;
  int64_t held_bytes_ = 0;
  char* next_ = nullptr;
  int64_t left_ = 0;
};

class CudaSession {
 public:
  static constexpr bool kHostKnowsCounts = false;

  explicit CudaSession(const torch::stable::Tensor& like)
      : guard_(like.get_device_index()), memory_(like), context_{current_stream(like), memory_, device_share()} {}
  CudaSession(const CudaSession&) = delete;
  CudaSession& operator=(const CudaSession&) = delete;

  const DeviceContext& context() const { return context_; }

 private:
  static CUstream_st* current_stream(const torch::stable::Tensor& tensor) {
    STD_TORCH_CHECK(aoti_torch_get_current_cuda_stream != nullptr, "pgccd: a CUDA tensor of a torch without CUDA");
    void* stream = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(tensor.get_device_index(), &stream));
    return static_cast<CUstream_st*>(stream);
  }

  torch::stable::accelerator::DeviceGuard guard_;
  TorchMemory memory_;
  DeviceContext context_;
};

}  // namespace pgccd::bind
