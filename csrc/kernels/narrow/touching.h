// Proofs of contact on straight paths: that two primitives touch within a short interval. They prevent near misses from
// being reported; without a proof, the query is solved again in higher precision.
#pragma once

#include "kernels/narrow/certificates.h"

namespace pgccd {

namespace touching_detail {

// A product of two vectors in the plane without one coordinate, over a time window: a quadratic in Bernstein form.
template <class T>
struct Quadratic {
  T control[3];
};

template <class T>
struct PlaneVector {
  T x, y;
};

template <class T>
PGCCD_HD PlaneVector<T> drop(Vec3<T> v, int axis) {
  if (axis == 0) return {v.y, v.z};
  if (axis == 1) return {v.z, v.x};
  return {v.x, v.y};
}

template <class T>
PGCCD_HD T cross(PlaneVector<T> p, PlaneVector<T> q) {
  return p.x * q.y - p.y * q.x;
}

template <class T>
PGCCD_HD Quadratic<T> cross(Vec3<T> p0, Vec3<T> p1, Vec3<T> q0, Vec3<T> q1, int axis) {
  const PlaneVector<T> from_p = drop(p0, axis), to_p = drop(p1, axis), from_q = drop(q0, axis), to_q = drop(q1, axis);
  return {{cross(from_p, from_q), T(0.5) * (cross(from_p, to_q) + cross(to_p, from_q)), cross(to_p, to_q)}};
}

template <class T>
PGCCD_HD T determinant(const FeaturePair<T>& p) {
  return dot(p.r, cross(p.a, p.b));
}

}  // namespace touching_detail

// True if the primitives certainly pass through one another between the two times: seen along a coordinate axis, the
// vertex stays inside the triangle, or the edges cross, throughout; and the sign of the determinant changes. So they
// are coplanar at some time, and touch then. `start` and `end` are on straight paths.
template <FeatureKind kKind, class T>
PGCCD_HD bool pass_through(const FeaturePair<T>& start, const FeaturePair<T>& end, PairError<T> error) {
  using namespace touching_detail;
  const FeatureLengths<T> length = lengths_of(start, end);
  const T side_rounding = determinant_rounding(length, error);
  const T side0 = determinant(start), side1 = determinant(end);
  const bool changes_sides =
      (side0 > side_rounding && -side1 > side_rounding) || (-side0 > side_rounding && side1 > side_rounding);
  if (!changes_sides) return false;

  const Vec3<T> normal = pgccd::cross(start.a, start.b);
  const T nx = magnitude(normal.x), ny = magnitude(normal.y), nz = magnitude(normal.z);
  const int axis = nx > ny ? (nx > nz ? 0 : 2) : (ny > nz ? 1 : 2);
  const Quadratic<T> ab = cross(start.a, end.a, start.b, end.b, axis);
  const Quadratic<T> ar = cross(start.a, end.a, start.r, end.r, axis);
  const Quadratic<T> br = cross(start.b, end.b, start.r, end.r, axis);
  // Three products of two vectors each, with their errors.
  const T sum = length.a + length.b + length.r;
  const T rounding = T(32) * T(Precision<T>::unit) * (sum * sum) + T(4.1) * difference_error(error) * sum;
  const T sign = ab.control[1] < T(0) ? T(-1) : T(1);
  for (int k = 0; k < 3; ++k) {
    // The crossing is at u = p / w, v = q / w.
    const T w = sign * ab.control[k], q = -sign * ar.control[k];
    const T p = kIsEdgeEdge<kKind> ? -sign * br.control[k] : sign * br.control[k];
    if (!(p > rounding) || !(q > rounding)) return false;
    if (kIsEdgeEdge<kKind> ? !(w - p > rounding && w - q > rounding) : !(w - p - q > rounding)) return false;
  }
  return true;
}

// Tries to find such a proof just after a time at which the primitives are `distance` apart, by one Newton step.
// `with_slender` as for `nearest_points`.
template <FeatureKind kKind, class T, class Path>
PGCCD_HD bool certainly_touch(const Path& path, T t, const FeaturePair<T>& now, const Nearest<T>& nearest, T distance,
                              T separation, T noise, bool with_slender) {
  using touching_detail::determinant;
  const FeaturePair<T> velocity = path.velocity();
  if (separation > T(0)) {
    if (distance + noise < separation) return true;
    const Vec3<T> change = kIsEdgeEdge<kKind> ? velocity.r + nearest.v * velocity.b - nearest.u * velocity.a
                                              : velocity.r + (nearest.u * velocity.a + nearest.v * velocity.b);
    const T speed = -dot(nearest.offset, change) / distance;
    if (!(speed > T(0))) return false;
    const T until = smaller(t + T(4) * ((distance - separation) + noise) / speed, T(1));
    if (!(until > t)) return false;
    const T distance_then = norm(nearest_points<kKind>(path.at(until), with_slender).offset);
    return distance_then + noise < separation;
  }
  const PairError<T> error = path.error();
  const Vec3<T> normal = cross(now.a, now.b);
  const T side = determinant(now);
  const T slope = magnitude(dot(velocity.r, normal) + dot(now.r, cross(velocity.a, now.b) + cross(now.a, velocity.b)));
  const T rounding = determinant_rounding(lengths_of(now, now), error);
  const T until_crossing = magnitude(side) / slope, margin = T(4) * rounding / slope;
  const T from = larger(t - margin, T(0)), to = smaller(t + T(2) * until_crossing + margin, T(1));
  return pass_through<kKind>(path.at(from), path.at(to), error);
}

}  // namespace pgccd
