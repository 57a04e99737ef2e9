// The elementary operators, written once for both backends and both precisions.
#pragma once

#include <tuple>

#include "bind/outputs.h"
#include "kernels/narrow/elementary_item.h"

namespace pgccd::bind {

using ElementaryTensors = std::tuple<Tensor, Tensor, Tensor, Tensor>;

template <class Backend>
struct ElementaryOps {
  template <bool kEdgeEdge>
  static ElementaryTensors elementary(const Tensor& points_t0, const Tensor& points_t1, double min_separation,
                                      double tolerance, bool nonzero_toi) {
    check_separation(min_separation);
    check_tolerance(tolerance);
    STD_TORCH_CHECK(tolerance >= 0.0, "tolerance: expected a length >= 0, got ", tolerance);
    const NarrowSettings settings{min_separation, tolerance, nonzero_toi};
    if (points_t0.scalar_type() == ScalarType::Float) {
      return elementary_in<kEdgeEdge, float>(points_t0, points_t1, settings);
    }
    return elementary_in<kEdgeEdge, double>(points_t0, points_t1, settings);
  }

 private:
  template <bool kEdgeEdge, class T>
  static ElementaryTensors elementary_in(const Tensor& points_t0, const Tensor& points_t1,
                                         const NarrowSettings& settings) {
    const T* x0 = rows<T>(points_t0, "points_t0", {kAnySize, 4, 3});
    const int64_t count = points_t0.size(0);
    const T* x1 = rows<T>(points_t1, "points_t1", {count, 4, 3});
    Tensor status = new_tensor<int8_t>(points_t0, {count});
    Tensor toi = new_tensor<T>(points_t0, {count});
    Tensor coordinates = new_tensor<T>(points_t0, {count, 2});
    Tensor significant_bits = new_tensor<int8_t>(points_t0, {count});
    const ElementaryColumns<T> out{data<int8_t>(status), data<T>(toi), data<T>(coordinates),
                                   data<int8_t>(significant_bits)};
    Backend(points_t0).template elementary<kEdgeEdge>(x0, x1, count, settings, out);
    return {status, toi, coordinates, significant_bits};
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_ELEMENTARY_OPS(library, Backend)                                                   \
  library.impl("vertex_face", TORCH_BOX(&OnOneDevice<&ElementaryOps<Backend>::elementary<false>>::call)); \
  library.impl("edge_edge", TORCH_BOX(&OnOneDevice<&ElementaryOps<Backend>::elementary<true>>::call))

}  // namespace pgccd::bind
