// The operator of swept spheres' boxes, written once for both backends.
#pragma once

#include "bind/detect_ops.h"

namespace pgccd::bind {

template <class Backend>
std::tuple<Tensor, Tensor> swept_boxes(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                                       double min_separation, double tolerance) {
  const BroadBodies bodies =
      broad_view(position_t0, position_t1, radius, {}, {}, {}, {}, {}, {min_separation, tolerance});
  Tensor lower = new_tensor<double>(radius, {bodies.count, 3}), upper = new_tensor<double>(radius, {bodies.count, 3});
  Backend(radius).swept_boxes(bodies, data<double>(lower), data<double>(upper));
  return {lower, upper};
}

}  // namespace pgccd::bind
