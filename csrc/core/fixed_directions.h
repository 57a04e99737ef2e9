// A test whether a few directions show that two primitives stay apart on straight paths. In float32, rounding included;
// on the host, eight pairs at a time. It rejects most of the pairs with overlapping bounds.
//
// The first directions are fixed. Then a search by Frank & Wolfe (1956): steps towards the point nearest to the origin
// in the convex hull of all differences of two corners, at both ends; each direction is that of the current point.
#pragma once

#include "core/feature_pair.h"
#include "core/lanes.h"
#include "core/rounding.h"

namespace pgccd {

constexpr int kDirectionSteps = 8;

namespace fixed_directions_detail {

template <class T>
PGCCD_HD T largest_coordinate(Vec3<T> v) {
  return larger(larger(larger(v.x, -v.x), larger(v.y, -v.y)), larger(v.z, -v.z));
}

// Sum of magnitudes: an upper bound of the length.
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
  T ahead, behind;  // minimum of direction . (second - first) over all pairs of corners, and of the reverse

#if !defined(__CUDACC__)
  friend Gaps select(Mask8 mask, const Gaps& a, const Gaps& b) {
    return {mask ? a.ahead : b.ahead, mask ? a.behind : b.behind};
  }
#endif
};

// Calls use(whether it is an edge-edge pair) for one pair, or for lanes of one kind; for lanes of both, it takes each
// lane from the result for its kind.
template <class Use>
PGCCD_HD auto by_kind(bool is_edge_edge, const Use& use) {
  return is_edge_edge ? use(true) : use(false);
}
#if !defined(__CUDACC__)
template <class Use>
PGCCD_HD auto by_kind(Mask8 is_edge_edge, const Use& use) {
  return select(is_edge_edge, use(true), use(false));
}
#endif

template <class T, class Kind>
PGCCD_HD Gaps<T> gaps(const FeaturePair<T>& p, Vec3<T> direction, Kind is_edge_edge) {
  const T zero{};
  const T r = dot(direction, p.r), a = dot(direction, p.a), b = dot(direction, p.b);
  return by_kind(is_edge_edge, [&](bool is_so) -> Gaps<T> {
    if (is_so) return {r + (smaller(-a, zero) + smaller(b, zero)), -(r + (larger(-a, zero) + larger(b, zero)))};
    return {r + smaller(smaller(a, b), zero), -(r + larger(larger(a, b), zero))};
  });
}

// Vector from the midpoint of the first primitive to that of the second, times 2 or 3.
template <class T, class Kind>
PGCCD_HD Vec3<T> between_middles(const FeaturePair<T>& p, Kind is_edge_edge) {
  return by_kind(is_edge_edge,
                 [&](bool is_so) -> Vec3<T> { return is_so ? 2.0f * p.r + (p.b - p.a) : 3.0f * p.r + (p.a + p.b); });
}

template <class T>
struct Limits {
  T extent, apart, sum;

  PGCCD_HD Limits(const FeaturePair<T>& start, const FeaturePair<T>& end, float distance) {
    constexpr float unit = Precision<float>::unit;
    extent = larger(largest_coordinate(start.r), largest_coordinate(end.r)) +
             (larger(largest_coordinate(start.a), largest_coordinate(end.a)) +
              larger(largest_coordinate(start.b), largest_coordinate(end.b)));
    // Per unit of the direction's length: coordinates rounded to float (1), dot products (3), their sum (2), each times
    // the extent, doubled as a safety margin.
    apart = distance * (1.0f + 8.0f * unit) + (20.0f * unit) * extent;
    // Minima may drop NaN; a sum does not.
    sum = sum_of_coordinates(start) + sum_of_coordinates(end);
  }

  // Outside of this range products might overflow or underflow.
  PGCCD_HD auto in_range() const { return (extent > 0x1p-40f) & (extent < 0x1p40f) & (sum == sum); }
};

template <class T>
struct LeastDifference {
  T along;
  Vec3<T> difference;
};

// Differences of two corners, four at the start and four at the end.
template <class T>
class CornerDifferences {
 public:
  template <class Kind>
  PGCCD_HD CornerDifferences(const FeaturePair<T>& start, const FeaturePair<T>& end, Kind is_edge_edge) {
    for (int at_end = 0; at_end < 2; ++at_end) {
      const FeaturePair<T>& p = at_end == 0 ? start : end;
      Vec3<T>* const four = all_ + 4 * at_end;
      const Vec3<T> with_b = p.r + p.b;
      four[0] = p.r;
      four[1] = with_b;
      four[2] = by_kind(is_edge_edge, [&](bool is_so) { return is_so ? p.r - p.a : p.r + p.a; });
      four[3] = by_kind(is_edge_edge, [&](bool is_so) { return is_so ? with_b - p.a : with_b; });
    }
  }

  // The least difference along a direction; ties are broken by the first.
  PGCCD_HD LeastDifference<T> least_along(Vec3<T> direction) const {
    LeastDifference<T> least{dot(direction, all_[0]), all_[0]};
    PGCCD_UNROLL
    for (int k = 1; k < 8; ++k) {
      const T along = dot(direction, all_[k]);
      const auto is_less = along < least.along;
      least = {select(is_less, along, least.along), select(is_less, all_[k], least.difference)};
    }
    return least;
  }

 private:
  Vec3<T> all_[8];
};

}  // namespace fixed_directions_detail

// Where the primitives certainly stay further apart than `distance`; T is float or lanes of it. `out` where the answer
// is not needed. The gap along a fixed direction is concave in time, so it suffices to test both ends of the step.
template <class T, class Kind, class Mask>
PGCCD_HD Mask stays_apart(const FeaturePair<T>& start, const FeaturePair<T>& end, float distance, Kind is_edge_edge,
                          Mask out) {
  using namespace fixed_directions_detail;
  const Limits<T> limits(start, end, distance);
  const auto separates = [&](Vec3<T> direction) {
    const T length = length_bound(direction);
    const T threshold = length * limits.apart;
    const Gaps<T> at_start = gaps(start, direction, is_edge_edge), at_end = gaps(end, direction, is_edge_edge);
    return limits.in_range() & (length > 1e-24f) &
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
  out = out | separates(direction(0));
  PGCCD_KEEP_LOOP
  for (int k = 1; k < 5 && !all_lanes(out); ++k) out = out | separates(direction(k));
  return out;
}

// The same by the search described above. It rejects more pairs than the fixed directions, and is slower.
template <class T, class Kind, class Mask>
PGCCD_HD Mask stays_apart_stepwise(const FeaturePair<T>& start, const FeaturePair<T>& end, float distance,
                                   Kind is_edge_edge, Mask out) {
  using namespace fixed_directions_detail;
  const Limits<T> limits(start, end, distance);
  const auto in_range = limits.in_range();
  if (!any_lane(in_range)) return out;
  const CornerDifferences<T> differences(start, end, is_edge_edge);
  const auto part = by_kind(is_edge_edge, [](bool is_so) { return T{} + (is_so ? 0.25f : 1.0f / 6.0f); });
  Vec3<T> reached = part * (between_middles(start, is_edge_edge) + between_middles(end, is_edge_edge));
  PGCCD_KEEP_LOOP
  for (int step = 0; step < kDirectionSteps && !all_lanes(out); ++step) {
    const LeastDifference<T> least = differences.least_along(reached);
    const T length_squared = norm_squared(reached);
    out = out | (in_range & (length_squared > 1e-24f) & (least.along > square_root(length_squared) * limits.apart));
    const Vec3<T> change = least.difference - reached;
    reached = reached + unit_clamp(-dot(reached, change) / norm_squared(change)) * change;
  }
  return out;
}

}  // namespace pgccd
