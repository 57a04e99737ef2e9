// A vertex-face or edge-edge pair at one instant, written by three difference vectors, so that nothing depends on where
// in space it is:
//   vertex-face (x0 vertex; x1, x2, x3 face):    r = x1 - x0, a = x2 - x1, b = x3 - x1
//   edge-edge   (x0, x1 one edge; x2, x3 other): r = x2 - x0, a = x1 - x0, b = x3 - x2
// In both, the four points are coplanar where r . (a x b) = 0.
#pragma once

#include <cmath>

#include "core/rounding.h"
#include "core/vec3.h"

namespace pgccd {

template <class T>
struct FeaturePair {
  Vec3<T> r, a, b;
};

template <bool kEdgeEdge, class T>
PGCCD_HD FeaturePair<T> feature_pair(Vec3<T> x0, Vec3<T> x1, Vec3<T> x2, Vec3<T> x3) {
  if constexpr (kEdgeEdge) return {x2 - x0, x1 - x0, x3 - x2};
  return {x1 - x0, x2 - x1, x3 - x1};
}

// Largest coordinates, added up: an upper bound of every coordinate of every difference of two of the points.
template <class T>
PGCCD_HD T extent(const FeaturePair<T>& p) {
  return (max_abs(p.r) + max_abs(p.a)) + max_abs(p.b);
}

// Nearest points of the two primitives. `offset` leads from the first primitive (vertex, first edge) to the second.
//   vertex-face: the face point x1 + u a + v b;   edge-edge: x0 + u a on the first edge, x2 + v b on the second.
template <class T>
struct Nearest {
  Vec3<T> offset;
  T u, v;
  bool inside;  // neither at the border of the face nor at an end of an edge
};

template <class T>
PGCCD_HD T clamped_ratio(T numerator, T denominator) {
  // A degenerate edge has no direction: its start stands for all of it.
  if (!(denominator > T(0))) return T(0);
  return unit_clamp(numerator / denominator);
}

namespace nearest_detail {

// Parameter of the point of origin + s * direction, s in [0, 1], that is nearest to zero.
template <class T>
PGCCD_HD T nearest_on_segment(Vec3<T> origin, Vec3<T> direction) {
  return clamped_ratio(-dot(origin, direction), norm_squared(direction));
}

template <class T>
PGCCD_HD void keep_nearer(Nearest<T>& best, T& best_squared, Vec3<T> offset, T u, T v) {
  const T squared = norm_squared(offset);
  if (squared < best_squared) {
    best_squared = squared;
    best = {offset, u, v, false};
  }
}

}  // namespace nearest_detail

// The result steers the search and bounds the distance from above; no certificate of freedom rests on its accuracy.
template <bool kEdgeEdge, class T>
PGCCD_HD Nearest<T> nearest_points(const FeaturePair<T>& p) {
  using nearest_detail::keep_nearer;
  using nearest_detail::nearest_on_segment;
  const Vec3<T> normal = cross(p.a, p.b);
  const T normal_squared = norm_squared(normal);
  // A face or an angle too slender for its normal to mean anything: its border, at most this slenderness away, stands
  // for it.
  constexpr T slender = T(64) * Precision<T>::unit;
  const bool has_normal = normal_squared > (slender * slender) * (norm_squared(p.a) * norm_squared(p.b));
  Nearest<T> best{p.r, T(0), T(0), false};
  T best_squared = norm_squared(p.r);

  if constexpr (kEdgeEdge) {
    // Lines: u |n|^2 = det(r, b, n), v |n|^2 = det(r, a, n).
    const T u = dot(cross(p.r, p.b), normal);
    const T v = dot(cross(p.r, p.a), normal);
    if (has_normal && u > T(0) && v > T(0) && u < normal_squared && v < normal_squared) {
      return {(dot(normal, p.r) / normal_squared) * normal, u / normal_squared, v / normal_squared, true};
    }
    const T v0 = nearest_on_segment(p.r, p.b);
    keep_nearer(best, best_squared, p.r + v0 * p.b, T(0), v0);
    const Vec3<T> from_end = p.r - p.a;
    const T v1 = nearest_on_segment(from_end, p.b);
    keep_nearer(best, best_squared, from_end + v1 * p.b, T(1), v1);
    const T u0 = nearest_on_segment(p.r, -p.a);
    keep_nearer(best, best_squared, p.r - u0 * p.a, u0, T(0));
    const Vec3<T> to_end = p.r + p.b;
    const T u1 = nearest_on_segment(to_end, -p.a);
    keep_nearer(best, best_squared, to_end - u1 * p.a, u1, T(1));
  } else {
    // Barycentric coordinates of the projection: u |n|^2 = det(b, r, n), v |n|^2 = det(r, a, n).
    const T u = dot(cross(p.b, p.r), normal);
    const T v = dot(cross(p.r, p.a), normal);
    if (has_normal && u > T(0) && v > T(0) && u + v < normal_squared) {
      return {(dot(normal, p.r) / normal_squared) * normal, u / normal_squared, v / normal_squared, true};
    }
    const T along_a = nearest_on_segment(p.r, p.a);
    keep_nearer(best, best_squared, p.r + along_a * p.a, along_a, T(0));
    const T along_b = nearest_on_segment(p.r, p.b);
    keep_nearer(best, best_squared, p.r + along_b * p.b, T(0), along_b);
    const Vec3<T> far_start = p.r + p.a;
    const Vec3<T> far_edge = p.b - p.a;
    const T along_far = nearest_on_segment(far_start, far_edge);
    keep_nearer(best, best_squared, far_start + along_far * far_edge, T(1) - along_far, along_far);
  }
  return best;
}

}  // namespace pgccd
