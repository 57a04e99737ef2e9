// Making tensors for results.
#pragma once

#include <stdexcept>
#include <string>

#include "bind/arguments.h"

namespace pgccd::bind {

// What torch's allocator says of too little memory does not reach us; what was asked for, and what helps, is ours to
// say.
inline Tensor new_empty(const Tensor& like, const std::vector<int64_t>& sizes, ScalarType type, int64_t bytes) {
  try {
    return torch::stable::new_empty(like, sizes, type);
  } catch (const std::exception&) {
    throw std::runtime_error("out of memory: no room for " + std::to_string(bytes) +
                             " more bytes; a smaller memory_budget or capacity, or fewer bodies at a time, take less");
  }
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
