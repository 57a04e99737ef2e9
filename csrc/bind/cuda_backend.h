// What every operator on a CUDA device needs from torch: its device made current, its stream, and memory from its
// allocator.
#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <vector>

#include "bind/scratch_peak.h"
#include "kernels/device_context.h"

namespace pgccd::bind {

// Freed with the operator: torch's allocator is ordered by stream, so kernels still in flight keep what they use.
class TorchMemory final : public DeviceMemory {
 public:
  explicit TorchMemory(const torch::stable::Tensor& like) : like_(like) {}

  void* allocate_bytes(int64_t bytes) override {
    held_.push_back(torch::stable::new_empty(like_, {bytes > 0 ? bytes : 1}, torch::headeronly::ScalarType::Byte));
    held_bytes_ += bytes;
    scratch_peak() = std::max(scratch_peak(), held_bytes_);
    return held_.back().data_ptr();
  }

 private:
  torch::stable::Tensor like_;
  std::vector<torch::stable::Tensor> held_;
  int64_t held_bytes_ = 0;
};

class CudaSession {
 public:
  explicit CudaSession(const torch::stable::Tensor& like)
      : guard_(like.get_device_index()), memory_(like), context_{current_stream(like), memory_} {}
  CudaSession(const CudaSession&) = delete;
  CudaSession& operator=(const CudaSession&) = delete;

  const DeviceContext& context() const { return context_; }

 private:
  static CUstream_st* current_stream(const torch::stable::Tensor& tensor) {
    void* stream = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(tensor.get_device_index(), &stream));
    return static_cast<CUstream_st*>(stream);
  }

  torch::stable::accelerator::DeviceGuard guard_;
  TorchMemory memory_;
  DeviceContext context_;
};

}  // namespace pgccd::bind
