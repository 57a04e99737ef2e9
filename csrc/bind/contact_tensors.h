// Contact rows as tensors.
#pragma once

#include <tuple>

#include "bind/outputs.h"
#include "kernels/narrow/narrow.h"

namespace pgccd::bind {

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

inline Report report_of(int64_t report) {
  STD_TORCH_CHECK(report >= 0 && report <= 2, "report: expected 0 (any), 1 (first) or 2 (all), got ", report);
  return static_cast<Report>(report);
}

}  // namespace pgccd::bind
