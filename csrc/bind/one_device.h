// Checks that all tensors of a call are on one device.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

namespace pgccd::bind {

struct DeviceOf {
  explicit DeviceOf(const torch::stable::Tensor& tensor)
      : is_cuda(tensor.is_cuda()), index(static_cast<int32_t>(tensor.get_device_index())) {}
  bool operator==(const DeviceOf&) const = default;

  bool is_cuda;
  int32_t index;
};

// The device of the operator that runs on this thread: that of its first tensor, recorded since the tensor may be moved
// from.
class DeviceScope {
 public:
  explicit DeviceScope(const torch::stable::Tensor* first)
      : before_(std::exchange(current(), first != nullptr ? std::optional(DeviceOf(*first)) : std::nullopt)) {}
  ~DeviceScope() { current() = before_; }
  DeviceScope(const DeviceScope&) = delete;
  DeviceScope& operator=(const DeviceScope&) = delete;

  static std::optional<DeviceOf>& current() {
    thread_local std::optional<DeviceOf> device;
    return device;
  }

 private:
  std::optional<DeviceOf> before_;
};

inline void check_device(const torch::stable::Tensor& tensor, const char* name) {
  const std::optional<DeviceOf>& expected = DeviceScope::current();
  STD_TORCH_CHECK(!expected || DeviceOf(tensor) == *expected, name, ": on another device than the first tensor");
}

namespace one_device_detail {

inline const torch::stable::Tensor* first_in(const torch::stable::Tensor& tensor) { return &tensor; }
inline const torch::stable::Tensor* first_in(const std::optional<torch::stable::Tensor>& tensor) {
  return tensor ? &*tensor : nullptr;
}
inline const torch::stable::Tensor* first_in(const std::vector<torch::stable::Tensor>& tensors) {
  return tensors.empty() ? nullptr : tensors.data();
}
inline const torch::stable::Tensor* first_in(const std::vector<std::optional<torch::stable::Tensor>>& tensors) {
  for (const auto& tensor : tensors) {
    if (tensor) return &*tensor;
  }
  return nullptr;
}
template <class T>
const torch::stable::Tensor* first_in(const T&) {
  return nullptr;
}

}  // namespace one_device_detail

// Wraps an operator: compares the device of each tensor with that of the first when it is viewed.
template <auto kOperator>
struct OnOneDevice;
template <class Result, class... Arguments, Result (*kOperator)(Arguments...)>
struct OnOneDevice<kOperator> {
  static Result call(Arguments... arguments) {
    const torch::stable::Tensor* first = nullptr;
    ((first = first != nullptr ? first : one_device_detail::first_in(arguments)), ...);
    const DeviceScope scope(first);
    return kOperator(std::forward<Arguments>(arguments)...);
  }
};

using Library = torch::stable::detail::StableLibrary;

// An operator as the dispatcher calls it.
#define PGCCD_BOX(operator_) TORCH_BOX(&OnOneDevice<&operator_>::call)

}  // namespace pgccd::bind
