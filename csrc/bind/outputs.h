// Making tensors for results.
#pragma once

#include "bind/arguments.h"

namespace pgccd::bind {

template <class T>
Tensor new_tensor(const Tensor& like, std::initializer_list<int64_t> shape) {
  const std::vector<int64_t> sizes(shape);
  return torch::stable::new_empty(like, sizes, scalar_type_of<T>());
}

template <class T>
T* data(Tensor& tensor) {
  return static_cast<T*>(tensor.data_ptr());
}

}  // namespace pgccd::bind
