// Allocation of result tensors.
#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>

#include <algorithm>
#include <stdexcept>
#include <string>

#include "bind/arguments.h"

namespace pgccd::bind {

// Contiguous, on the device of `like`. Calls the allocator directly: torch::stable::new_empty goes through the
// dispatcher, which takes as long again.
inline Tensor new_empty(const Tensor& like, const std::vector<int64_t>& sizes, ScalarType type, int64_t bytes) {
  int32_t device_type = 0, device_index = 0;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_type(like.get(), &device_type));
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_index(like.get(), &device_index));
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t axis = sizes.size(); axis-- > 1;) strides[axis - 1] = strides[axis] * std::max<int64_t>(sizes[axis], 1);
  const auto dtype = torch::stable::detail::to<int32_t>(torch::stable::detail::from(type));
  AtenTensorHandle made = nullptr;
  const AOTITorchError result = aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(),
                                                         strides.data(), dtype, device_type, device_index, &made);
  // The stable ABI drops the message of torch's allocator, so the error states the requested size and a remedy.
  if (result != AOTI_TORCH_SUCCESS) {
    throw std::runtime_error("out of memory: no room for " + std::to_string(bytes) +
                             " more bytes; a smaller memory_budget or capacity, or fewer bodies at a time, take less");
  }
  return Tensor(made);
}

template <class T>
Tensor new_tensor(const Tensor& like, std::initializer_list<int64_t> shape) {
  const std::vector<int64_t> sizes(shape);
  int64_t bytes = sizeof(T);
  for (const int64_t size : sizes) bytes *= size;
  return new_empty(like, sizes, scalar_type_of<T>(), bytes);
}

template <class T>
T* data(Tensor& tensor) {
  return static_cast<T*>(tensor.data_ptr());
}

}  // namespace pgccd::bind
