// Do a few fixed directions show that two primitives stay apart while they move straight? In float, with its rounding
// allowed for; on the host, eight pairs at a time. Most of the pairs that overlapping bounds propose end here.
#pragma once

#include "core/feature_pair.h"
#include "core/lanes.h"
#include "core/rounding.h"

namespace pgccd {

namespace fixed_directions_detail {

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

template <class T>
PGCCD_HD Gaps<T> gaps(const FeaturePair<T>& p, Vec3<T> direction, bool is_edge_edge) {
  const T zero{};
  const T r = dot(direction, p.r), a = dot(direction, p.a), b = dot(direction, p.b);
  if (is_edge_edge) return {r + (smaller(-a, zero) + smaller(b, zero)), -(r + (larger(-a, zero) + larger(b, zero)))};
  return {r + smaller(smaller(a, b), zero), -(r + larger(larger(a, b), zero))};
}

// From the middle of the first primitive to the middle of the second, times 2 or 3.
template <class T>
PGCCD_HD Vec3<T> between_middles(const FeaturePair<T>& p, bool is_edge_edge) {
  return is_edge_edge ? 2.0f * p.r + (p.b - p.a) : 3.0f * p.r + (p.a + p.b);
}

}  // namespace fixed_directions_detail

// True where the primitives certainly stay further apart than `distance`; T is float or lanes of it. The gap along a
// fixed direction is concave in time, so both ends of the step decide.
template <class T>
PGCCD_HD auto stays_apart(const FeaturePair<T>& start, const FeaturePair<T>& end, float distance, bool is_edge_edge) {
  using namespace fixed_directions_detail;
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
    const Gaps<T> at_start = gaps(start, direction, is_edge_edge), at_end = gaps(end, direction, is_edge_edge);
    return in_range & (length > 1e-24f) &
           (((at_start.ahead > threshold) & (at_end.ahead > threshold)) |
            ((at_start.behind > threshold) & (at_end.behind > threshold)));
  };
  const Vec3<T> middles_start = between_middles(start, is_edge_edge), middles_end = between_middles(end, is_edge_edge);
  const auto direction = [&](int k) -> Vec3<T> {
    switch (k) {
      case 0:
        return middles_start + middles_end;
      case 1:
        return cross(start.a, start.b);
      case 2:
        return cross(end.a, end.b);
      case 3:
        return middles_start;
      default:
        return middles_end;
    }
  };
  auto free = separates(direction(0));
  PGCCD_KEEP_LOOP
  for (int k = 1; k < 5 && !all_lanes(free); ++k) free = free | separates(direction(k));
  return free;
}

}  // namespace pgccd
