// Allocation of result tensors, and contact rows as tensors.
#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <tuple>

#include "bind/arguments.h"
#include "kernels/narrow/narrow.h"

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

// The columns of ContactRows.
using ContactTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

inline ContactTensors new_contact_tensors(const Tensor& like, int64_t count) {
  return {new_tensor<int32_t>(like, {count}),    new_tensor<int8_t>(like, {count}),
          new_tensor<int32_t>(like, {count, 2}), new_tensor<int8_t>(like, {count}),
          new_tensor<double>(like, {count}),     new_tensor<double>(like, {count, 2}),
          new_tensor<double>(like, {count, 3}),  new_tensor<double>(like, {count, 3})};
}

inline ContactColumns contact_columns(ContactTensors& tensors) {
  auto& [pair, kind, features, status, toi, coordinates, point, normal] = tensors;
  return {data<int32_t>(pair),  nullptr,           data<int8_t>(kind),        data<int32_t>(features),
          data<int8_t>(status), data<double>(toi), data<double>(coordinates), data<double>(point),
          data<double>(normal)};
}

}  // namespace pgccd::bind
