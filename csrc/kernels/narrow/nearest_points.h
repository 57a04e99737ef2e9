// Nearest points of the two primitives of a feature pair.
#pragma once

#include "core/feature_pair.h"
#include "core/rounding.h"

namespace pgccd {

// `offset` points from the first primitive (vertex, first edge) to the second.
//   vertex-face: the face point x1 + u a + v b;   edge-edge: x0 + u a on the first edge, x2 + v b on the second.
template <class T>
struct Nearest {
  Vec3<T> offset;
  // Parallel to `offset`, of any length, and perpendicular to the features that it connects to within a few roundings:
  // the offset itself loses its direction when it becomes small.
  Vec3<T> direction;
  T u, v;
};

namespace nearest_detail {

// A point's offset from the segment origin + s edge, s in [0, 1]; the parameters of both primitives are derived from s.
template <class T>
struct SegmentCase {
  Vec3<T> origin, edge;
  T s;
  Vec3<T> offset;
  T squared;
};

template <class T>
PGCCD_HD SegmentCase<T> nearest_on_segment(Vec3<T> origin, Vec3<T> edge) {
  const T length_squared = norm_squared(edge);
  // A degenerate edge has no direction; its start represents it.
  const T s = length_squared > T(0) ? unit_clamp(-dot(origin, edge) / length_squared) : T(0);
  const Vec3<T> offset = origin + s * edge;
  return {origin, edge, s, offset, norm_squared(offset)};
}

// Interior solution for nearly parallel edges, or sides of a face. Their normal is accurate only to u / sin(angle), and
// so would be a distance along it. Instead the longer one is projected out (Gram-Schmidt with pivoting): the remaining
// distance is that of two points of the features to within a few u of the extent, at any angle.
template <FeatureKind kKind, class T>
PGCCD_HD bool nearest_of_slender(const FeaturePair<T>& p, Vec3<T> normal, Nearest<T>& out) {
  const bool a_is_longer = norm_squared(p.a) > norm_squared(p.b);
  const Vec3<T> longer = a_is_longer ? p.a : p.b, shorter = a_is_longer ? p.b : p.a;
  const T length_squared = norm_squared(longer);
  const auto without_longer = [&](Vec3<T> x) { return x - (dot(x, longer) / length_squared) * longer; };
  const Vec3<T> r = without_longer(p.r), across = without_longer(shorter);
  // The face point (or, with the sign of u reversed, the offset between edge points) is r + along * longer + aside *
  // shorter.
  const T aside = -dot(r, across) / norm_squared(across);
  const T along = -dot(p.r + aside * shorter, longer) / length_squared;
  const T of_a = a_is_longer ? along : aside;
  out.u = kIsEdgeEdge<kKind> ? -of_a : of_a;
  out.v = a_is_longer ? aside : along;
  const bool inside =
      out.u > T(0) && out.v > T(0) && (kIsEdgeEdge<kKind> ? out.u < T(1) && out.v < T(1) : out.u + out.v < T(1));
  if (!inside) return false;
  out.offset = r + aside * across;
  // Perpendicular to the longer one to within rounding, which suffices: along the rest of the shorter one the features
  // extend by sin(angle) only.
  const Vec3<T> direction = without_longer(normal);
  out.direction = dot(direction, r) < T(0) ? -direction : direction;
  return true;
}

// e x (o x e) = |e|^2 (o - its part along e): exact zeros are preserved, however small the result.
template <class T>
PGCCD_HD Nearest<T> from_segment(const SegmentCase<T>& c, T u, T v) {
  const bool within = c.s > T(0) && c.s < T(1);
  return {c.offset, within ? cross(c.edge, cross(c.origin, c.edge)) : c.offset, u, v};
}

}  // namespace nearest_detail

// The offset connects two points of the features to within 64 u of the extent: its length is an upper bound of the
// distance. Certificates do not depend on its accuracy.
// `with_slender`: also considers the interiors of features whose normal is inaccurate; otherwise their boundaries,
// which may be further apart, represent them.
template <FeatureKind kKind, class T>
PGCCD_HD Nearest<T> nearest_points(const FeaturePair<T>& p, bool with_slender = true) {
  using nearest_detail::from_segment;
  using nearest_detail::nearest_on_segment;
  const Vec3<T> normal = cross(p.a, p.b);
  const T normal_squared = norm_squared(normal);
  // A face or angle too slender for an accurate normal, or too small for its square, is represented by its boundary, at
  // a distance below the rounding of coordinates.
  constexpr T slender(64 * Precision<T>::unit);
  const T parallel_squared = norm_squared(p.a) * norm_squared(p.b);  // times sin^2 of the angle gives normal_squared
  const bool has_normal =
      normal_squared > (slender * slender) * parallel_squared && normal_squared > T(Precision<T>::smallest_square);
  // Edges' lines: u |n|^2 = det(r, b, n), v |n|^2 = det(r, a, n). Projection onto the face: u |n|^2 = det(b, r, n),
  // same v.
  const T u = kIsEdgeEdge<kKind> ? dot(cross(p.r, p.b), normal) : dot(cross(p.b, p.r), normal);
  const T v = dot(cross(p.r, p.a), normal);
  // Below a sine of 1/8, the distance along the normal has an error above the noise bound of `advance_in_phase`.
  const bool is_slender = !(normal_squared > T(0x1p-6) * parallel_squared);
  const bool inside = has_normal && !is_slender && u > T(0) && v > T(0) &&
                      (kIsEdgeEdge<kKind> ? u < normal_squared && v < normal_squared : u + v < normal_squared);
  if (inside) {
    const T along = dot(normal, p.r);
    return {(along / normal_squared) * normal, along < T(0) ? -normal : normal, u / normal_squared, v / normal_squared};
  }
  if (with_slender && has_normal && is_slender) {
    Nearest<T> interior;
    if (nearest_detail::nearest_of_slender<kKind>(p, normal, interior)) return interior;
  }

  auto best = nearest_on_segment(p.r, p.b);
  if constexpr (kIsEdgeEdge<kKind>) {
    int which = 0;  // end 0 or 1 of the first edge on the second, end 0 or 1 of the second edge on the first
    const auto consider = [&](Vec3<T> origin, Vec3<T> edge, int candidate) {
      const auto other = nearest_on_segment(origin, edge);
      if (!(other.squared < best.squared)) return;
      best = other;
      which = candidate;
    };
    consider(p.r - p.a, p.b, 1);
    consider(p.r, -p.a, 2);
    consider(p.r + p.b, -p.a, 3);
    if (which < 2) return from_segment(best, T(which), best.s);
    return from_segment(best, best.s, T(which - 2));
  } else {
    int which = 0;  // edges x1 x3, x1 x2, x2 x3
    const auto consider = [&](Vec3<T> origin, Vec3<T> edge, int candidate) {
      const auto other = nearest_on_segment(origin, edge);
      if (!(other.squared < best.squared)) return;
      best = other;
      which = candidate;
    };
    consider(p.r, p.a, 1);
    consider(p.r + p.a, p.b - p.a, 2);
    if (which == 0) return from_segment(best, T(0), best.s);
    if (which == 1) return from_segment(best, best.s, T(0));
    return from_segment(best, T(1) - best.s, best.s);
  }
}

// `v` normalised to length 1 to within 4 roundings, however small it is; zero if it is zero.
template <class T>
PGCCD_HD Vec3<T> unit_vector(Vec3<T> v) {
  T squared = norm_squared(v);
  if (!(squared > T(Precision<T>::smallest_square))) {
    const T largest = max_abs(v);
    if (!(largest > T(0))) return v;
    // Powers of two are exact.
    for (T size = largest; size < T(0x1p-40f); size = size * T(0x1p+40f)) v = T(0x1p+40f) * v;
    squared = norm_squared(v);
  }
  return (T(1) / square_root(squared)) * v;
}

// Unit vector of the direction along which the features are nearest.
template <class T>
PGCCD_HD Vec3<T> direction_of(const Nearest<T>& nearest) {
  return unit_vector(max_abs(nearest.direction) > T(0) ? nearest.direction : nearest.offset);
}

}  // namespace pgccd
