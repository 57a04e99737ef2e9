// Before a query is solved: do fixed directions show that the primitives stay apart for the whole step? In float, with
// its rounding allowed for; on the host, eight queries at a time. Most of the pairs that overlapping boxes propose end
// here.
#pragma once

#include "core/lanes.h"
#include "kernels/narrow/feature_pair.h"

namespace pgccd {

namespace cull_detail {

template <class T>
PGCCD_HD T largest_coordinate(Vec3<T> v) {
  return larger(larger(larger(v.x, -v.x), larger(v.y, -v.y)), larger(v.z, -v.z));
}

// Sum of magnitudes: at least the length.
template <class T>
PGCCD_HD T length_bound(Vec3<T> v) {
  return (larger(v.x, -v.x) + larger(v.y, -v.y)) + larger(v.z, -v.z);
}

template <class T>
PGCCD_HD T sum_of_coordinates(const FeaturePair<T>& p) {
  const Vec3<T> sum = p.r + (p.a + p.b);
  return sum.x + (sum.y + sum.z);
}

template <class T>
struct Gaps {
  T ahead, behind;  // the least of direction . (second - first) over all pairs of corners, and of the reverse
};

template <bool kEdgeEdge, class T>
PGCCD_HD Gaps<T> gaps(const FeaturePair<T>& p, Vec3<T> direction) {
  const T zero{};
  const T r = dot(direction, p.r), b = dot(direction, p.b);
  const T a = kEdgeEdge ? -dot(direction, p.a) : dot(direction, p.a);
  if constexpr (kEdgeEdge) {
    return {r + (smaller(a, zero) + smaller(b, zero)), -(r + (larger(a, zero) + larger(b, zero)))};
  }
  return {r + smaller(smaller(a, b), zero), -(r + larger(larger(a, b), zero))};
}

// From the middle of the first primitive to the middle of the second, times 2 or 3.
template <bool kEdgeEdge, class T>
PGCCD_HD Vec3<T> between_middles(const FeaturePair<T>& p) {
  if constexpr (kEdgeEdge) return 2.0f * p.r + (p.b - p.a);
  return 3.0f * p.r + (p.a + p.b);
}

}  // namespace cull_detail

// True where the primitives certainly stay further apart than `distance`; T is float or lanes of it. The gap along a
// fixed direction is concave in time, so both ends of the step decide.
template <bool kEdgeEdge, class T>
PGCCD_HD auto stays_apart(const FeaturePair<T>& start, const FeaturePair<T>& end, float distance) {
  using namespace cull_detail;
  constexpr float unit = Precision<float>::unit;
  const T extent = larger(largest_coordinate(start.r), largest_coordinate(end.r)) +
                   (larger(largest_coordinate(start.a), largest_coordinate(end.a)) +
                    larger(largest_coordinate(start.b), largest_coordinate(end.b)));
  // Per unit of the direction's length: coordinates rounded to float (1), dot products (3), their sum (2), each times
  // the extent, doubled for good measure; beyond the limits products might overflow or vanish.
  const T apart = distance * (1.0f + 8.0f * unit) + (20.0f * unit) * extent;
  // Minima may hide what is not a number; a sum does not.
  const T sum = sum_of_coordinates(start) + sum_of_coordinates(end);
  const auto in_range = (extent > 0x1p-40f) & (extent < 0x1p40f) & (sum == sum);
  const auto separates = [&](Vec3<T> direction) {
    const T length = length_bound(direction);
    const T threshold = length * apart;
    const Gaps<T> at_start = gaps<kEdgeEdge>(start, direction), at_end = gaps<kEdgeEdge>(end, direction);
    return in_range & (length > 1e-24f) &
           (((at_start.ahead > threshold) & (at_end.ahead > threshold)) |
            ((at_start.behind > threshold) & (at_end.behind > threshold)));
  };
  const Vec3<T> middles_start = between_middles<kEdgeEdge>(start), middles_end = between_middles<kEdgeEdge>(end);
  auto free = separates(middles_start + middles_end);
  if (all_lanes(free)) return free;
  free = free | separates(cross(start.a, start.b));
  if (all_lanes(free)) return free;
  free = free | separates(cross(end.a, end.b));
  if (all_lanes(free)) return free;
  free = free | separates(middles_start);
  if (all_lanes(free)) return free;
  return free | separates(middles_end);
}

}  // namespace pgccd
