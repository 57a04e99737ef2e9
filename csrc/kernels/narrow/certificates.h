// Certificates: proofs that two primitives stay further apart than a threshold over the first part of a time window.
// Vertices move on chords from `start` to `end`; the window's own time s runs from 0 to 1. Each function returns s such
// that [0, s] is certainly free: 0 if nothing is proven, 1 for the whole window (end included).
#pragma once

#include "kernels/narrow/nearest_points.h"

namespace pgccd {

// Bounds of the rounding error of this pair's difference vectors, over the whole step.
template <class T>
struct PairError {
  T point;   // each point, absolute
  T extent;  // upper bound of `extent(pair)` at any time
};

// Upper bounds of |r|, |a| and |b| between two times: |x| <= sqrt(3) max_abs(x), and chords are convex.
template <class T>
struct FeatureLengths {
  T r, a, b;
};

template <class T>
PGCCD_HD FeatureLengths<T> lengths_of(const FeaturePair<T>& start, const FeaturePair<T>& end) {
  const T root_three = T(1.7320509);
  return {root_three * larger(max_abs(start.r), max_abs(end.r)), root_three * larger(max_abs(start.a), max_abs(end.a)),
          root_three * larger(max_abs(start.b), max_abs(end.b))};
}

// Error bound of a difference vector: of its points, and of the interpolation between its ends.
template <class T>
PGCCD_HD T difference_error(PairError<T> error) {
  return T(2) * error.point + T(8) * T(Precision<T>::unit) * error.extent;
}

// Error bound of a computed coplanarity cubic, repeated clipping included.
template <class T>
PGCCD_HD T determinant_rounding(FeatureLengths<T> length, PairError<T> error) {
  const T product = length.a * length.b;
  return T(128) * T(Precision<T>::unit) * (product * length.r) +
         T(1.01) * difference_error(error) * (product + length.r * (length.a + length.b));
}

namespace certificate_detail {

// Where a line that starts at `from`, above the threshold, reaches it; 0 for NaN.
template <class T>
PGCCD_HD T prefix_of_line(T from, T to, T threshold) {
  if (to > threshold) return T(1);
  const T prefix = (from - threshold) / (from - to);
  return prefix > T(0) ? prefix : T(0);
}

}  // namespace certificate_detail

// A fixed direction: along it, the gap of two convex sets on straight paths is a minimum of linear functions of time,
// so the time at which it reaches the threshold is known in closed form. `direction` has unit length to within 4
// roundings.
template <FeatureKind kKind, class T>
PGCCD_HD T fixed_direction(const FeaturePair<T>& start, const FeaturePair<T>& end, Vec3<T> direction, T distance,
                           PairError<T> error) {
  using certificate_detail::prefix_of_line;
  constexpr T u(Precision<T>::unit);
  // Rounding of a projected gap: differences (1), dot products (3 each of three vectors), sums (2), and the threshold's
  // own.
  const T threshold = distance * (T(1) + T(16) * u) + (T(2) * error.point + T(32) * u * error.extent);
  const T r0 = dot(direction, start.r), a0 = dot(direction, start.a), b0 = dot(direction, start.b);
  const T r1 = dot(direction, end.r), a1 = dot(direction, end.a), b1 = dot(direction, end.b);
  T gap0[4], gap1[4];
  constexpr int count = kIsEdgeEdge<kKind> ? 4 : 3;
  gap0[0] = r0;
  gap1[0] = r1;
  gap0[1] = r0 + b0;
  gap1[1] = r1 + b1;
  if constexpr (kIsEdgeEdge<kKind>) {
    gap0[2] = r0 - a0;
    gap1[2] = r1 - a1;
    gap0[3] = (r0 - a0) + b0;
    gap1[3] = (r1 - a1) + b1;
  } else {
    gap0[2] = r0 + a0;
    gap1[2] = r1 + a1;
  }
  T prefix = T(1);
  for (int k = 0; k < count; ++k) {
    if (!(gap0[k] > threshold)) return T(0);
    prefix = smaller(prefix, prefix_of_line(gap0[k], gap1[k], threshold));
  }
  return prefix;
}

// A direction that rotates from `direction0` to `direction1` (unit vectors, the directions of the nearest points at the
// window's ends): n(s) = (1 - s) direction0 + s direction1. It follows rotating features, so its loss of the gap is of
// second order in the window's length, whereas that of a fixed direction is proportional to it. Each vertex pair's
// projection is a quadratic, as is the bound |n(s)| <= (1 + |n(s)|^2) / 2 = 1 - s (1 - s) (1 - direction0 .
// direction1).
template <FeatureKind kKind, class T>
PGCCD_HD T turning_direction(const FeaturePair<T>& start, const FeaturePair<T>& end, Vec3<T> direction0,
                             Vec3<T> direction1, T distance, PairError<T> error) {
  constexpr T u(Precision<T>::unit);
  // As for a fixed direction; the middle control points are means of two such projections.
  const T rounding = T(2) * error.point + T(32) * u * error.extent;
  const T at_ends = distance * (T(1) + T(16) * u) + rounding;
  const T in_middle = distance * (T(0.5) * (T(1) + dot(direction0, direction1)) + T(16) * u) + rounding;
  const T r0 = dot(direction0, start.r), a0 = dot(direction0, start.a), b0 = dot(direction0, start.b);
  const T r1 = T(0.5) * (dot(direction0, end.r) + dot(direction1, start.r));
  const T a1 = T(0.5) * (dot(direction0, end.a) + dot(direction1, start.a));
  const T b1 = T(0.5) * (dot(direction0, end.b) + dot(direction1, start.b));
  const T r2 = dot(direction1, end.r), a2 = dot(direction1, end.a), b2 = dot(direction1, end.b);
  T prefix = T(1);
  // All control points (0, c0), (1/2, c1), (1, c2) of a quadratic lie above the steepest line from the first to one of
  // the others, hence so does the curve.
  const auto limit = [&](T p0, T p1, T p2) {
    const T c0 = p0 - at_ends, c1 = p1 - in_middle, c2 = p2 - at_ends;
    const T steepest = smaller(T(2) * (c1 - c0), c2 - c0);
    const bool is_finite = magnitude(c1) + magnitude(c2) < T(INFINITY);
    if (!(c0 > T(0)) || !is_finite) {
      prefix = T(0);
    } else if (!(c0 + steepest > T(0))) {
      prefix = smaller(prefix, c0 / -steepest);
    }
  };
  limit(r0, r1, r2);
  limit(r0 + b0, r1 + b1, r2 + b2);
  if constexpr (kIsEdgeEdge<kKind>) {
    limit(r0 - a0, r1 - a1, r2 - a2);
    limit((r0 - a0) + b0, (r1 - a1) + b1, (r2 - a2) + b2);
  } else {
    limit(r0 + a0, r1 + a1, r2 + a2);
  }
  return prefix;
}

// The direction that moves with the features, n(s) = a(s) x b(s): the gap along it is the coplanarity cubic r . (a x b)
// in Bernstein form, bounded by its control polygon. Its first root is bracketed from the left by repeated clipping.
template <class T>
PGCCD_HD T moving_normal(const FeaturePair<T>& start, const FeaturePair<T>& end, T distance, PairError<T> error) {
  constexpr T u(Precision<T>::unit);
  const Vec3<T> n0 = cross(start.a, start.b);
  const Vec3<T> n1 = cross(start.a, end.b) + cross(end.a, start.b);  // twice the middle control point
  const Vec3<T> n2 = cross(end.a, end.b);
  T c0 = dot(start.r, n0);
  T c1 = (dot(end.r, n0) + dot(start.r, n1)) / T(3);
  T c2 = (dot(start.r, n2) + dot(end.r, n1)) / T(3);
  T c3 = dot(end.r, n2);
  if (c0 < T(0)) {
    c0 = -c0;
    c1 = -c1;
    c2 = -c2;
    c3 = -c3;
  }
  const T longest_squared = larger(larger(norm_squared(n0), T(0.25) * norm_squared(n1)), norm_squared(n2));
  // Accurate if c0 is above the rounding: the normal is then longer than (u extent)^2, whose square is far from
  // underflow.
  const T longest = square_root(longest_squared);
  const T rounding = determinant_rounding(lengths_of(start, end), error);
  const T threshold = distance * longest * (T(1) + T(16) * u) + rounding;
  const bool is_finite = c0 + ((magnitude(c1) + magnitude(c2)) + magnitude(c3)) < T(INFINITY);
  if (!(c0 > threshold) || !is_finite) return T(0);

  T prefix = T(0);
  constexpr int kMaxClips = 8;
  for (int clip = 0; clip < kMaxClips; ++clip) {
    // The polynomial on [prefix, 1] has control points c0 .. c3; c0 is above the threshold.
    if (c1 > threshold && c2 > threshold && c3 > threshold) return T(1);
    // A window of one and a half Newton steps fits the curve closely; it is limited to the remaining interval.
    const T fall = T(3) * (c0 - c1);
    const T reach = fall > T(0) ? smaller(T(1.5) * (c0 - threshold) / fall, T(1)) : T(1);
    const T d01 = c0 + reach * (c1 - c0), d12 = c1 + reach * (c2 - c1), d23 = c2 + reach * (c3 - c2);
    const T d012 = d01 + reach * (d12 - d01), d123 = d12 + reach * (d23 - d12);
    const T w3 = d012 + reach * (d123 - d012);
    // All of (1/3, d01), (2/3, d012), (1, w3) lie above the steepest line to one of them from (0, c0), hence so does
    // the curve.
    const T steepest = smaller(smaller(T(3) * (d01 - c0), T(1.5) * (d012 - c0)), w3 - c0);
    const T inner = threshold - c0 > steepest ? (threshold - c0) / steepest : T(1);
    const T step = inner * reach;
    const T advanced = prefix + step * (T(1) - prefix) * (T(1) - T(4) * u);
    if (!(advanced > prefix * (T(1) + T(0x1p-20)))) {
      prefix = larger(advanced, prefix);
      break;
    }
    prefix = advanced;
    // Restrict to the remaining interval.
    const T e01 = c0 + step * (c1 - c0), e12 = c1 + step * (c2 - c1), e23 = c2 + step * (c3 - c2);
    const T e012 = e01 + step * (e12 - e01), e123 = e12 + step * (e23 - e12);
    c0 = e012 + step * (e123 - e012);
    c1 = e123;
    c2 = e23;
    if (!(c0 > threshold)) break;
  }
  return prefix;
}

}  // namespace pgccd
