// A test whether two leaves certainly stay apart. It rejects most leaf pairs with overlapping spheres and slabs, before
// any triangle is transformed. A few steps of Frank & Wolfe (1956) approach the point nearest to the origin in the
// Minkowski difference of the convex hulls of the leaves' vertices, at both ends of a segment. Each step tests the
// direction of the current point for separation. T is float or, on the host, eight lanes of it, with the same result.
#pragma once

#include <bit>
#include <type_traits>

#include "kernels/traverse/time_spans.h"

namespace pgccd {

constexpr int kSeparationSteps = 4;

namespace separation_detail {

// The vertex of a leaf that is farthest along a direction; ties are broken by the first.
struct Farthest {
  float along = -HUGE_VALF;  // dot product with the direction
  int32_t row = 0;
  int slot = 0;

  PGCCD_HD void include(float product, int32_t its_row, int its_slot) {
    if (!(product > along)) return;
    along = product;
    row = its_row;
    slot = its_slot;
  }
#if !defined(__CUDACC__)
  void include(Float8 products, int32_t its_row, int) {
    const float most = largest_lane(products);
    if (most > along) include(most, its_row, std::countr_zero(lane_bits(products == most)));
  }
#endif
};

// Below the exact result of three operations and this one.
PGCCD_HD float rounded_down(float x) { return x * (1.0f - 4.0f * Precision<float>::unit); }

// The first part of a line in which it is above a threshold: `from` is, `to` is not, or is NaN (then zero).
PGCCD_HD float part_above(float from, float to, float threshold) {
  const float part = rounded_down((from - threshold) / (from - to));
  return part > 0.0f ? part : 0.0f;
}

// The time, as part of the step, of a part of segment k of several.
PGCCD_HD float time_in_step(int k, float part, int segments) {
  return rounded_down((static_cast<float>(k - 1) + part) / static_cast<float>(segments));
}

}  // namespace separation_detail

// Two leaves over segment k.
template <class T, class Bodies>
class LeafSeparation {
  using Sweep = typename PairTree<Bodies>::Sweep;
  using Farthest = separation_detail::Farthest;

 public:
  PGCCD_HD LeafSeparation(const PairTree<Bodies>& tree, NodePair leaves, int k)
      : tree_(tree), leaves_(leaves), start_(tree.pose(k - 1)), end_(tree.pose(k)), k_(k) {}

  // From the first sphere's centre to the second's, averaged over both ends: the initial point.
  PGCCD_HD Vec3<float> between_spheres() const {
    const MovingPoints<1, float> from = tree_.moving_centre(0, leaves_.first, k_);
    const MovingPoints<1, float> to = tree_.moving_centre(1, leaves_.second, k_);
    return 0.5f * ((to.start[0] - from.start[0]) + (to.end[0] - from.end[0]));
  }

  // True if the leaves certainly stay further apart than the pair's inflation along this direction; otherwise takes a
  // step, and raises `free_part`, the first part of the segment in which they certainly do: along a fixed direction,
  // the gap is concave in time. The error of a distance along a unit direction is below 32 units of rounding; the
  // inflation includes 64. The direction is scaled to unit length first: with large bodies, the scale of the poses
  // times that of a point near the origin would underflow.
  PGCCD_HD bool is_along(Vec3<float>& reached, float& free_part) const {
    const float length_squared = norm_squared(reached);
    if (!(length_squared > 1e-30f)) return false;
    const Vec3<float> direction = (1.0f / square_root(length_squared)) * reached;
    Farthest first[2], second[2];
    find_farthest(0, leaves_.first, direction, first);
    find_farthest(1, leaves_.second, -direction, second);
    const float gap_start = -second[0].along - first[0].along, gap_end = -second[1].along - first[1].along;
    const float distance = tree_.sweep().inflation * (1.0f + 8.0f * Precision<float>::unit);
    if (smaller(gap_start, gap_end) > distance) return true;
    if (gap_start > distance)
      free_part = larger(free_part, separation_detail::part_above(gap_start, gap_end, distance));
    const bool is_start = gap_start < gap_end;
    const Vec3<float> change =
        (place(1, is_start ? second[0] : second[1], is_start) - place(0, is_start ? first[0] : first[1], is_start)) -
        reached;
    reached = reached + unit_clamp(-dot(reached, change) / norm_squared(change)) * change;
    return false;
  }

  // The time, as part of the step, until which the leaves stay apart: all segments before this one, and part of it.
  PGCCD_HD float free_until(float free_part) const {
    return separation_detail::time_in_step(k_, free_part, tree_.sweep().segment_count);
  }

 private:
  PGCCD_HD const LeafPoints& points(int side, int32_t row) const { return tree_.sweep().leaf_rows[side][row]; }

  // The farthest vertices at both ends.
  PGCCD_HD void find_farthest(int side, int32_t node, Vec3<float> direction, Farthest out[2]) const {
    constexpr int kSlotsAtOnce = sizeof(T) / sizeof(float);
    // One slot at a time, the row is read as a whole first; eight slots are read where they are.
    using Row = std::conditional_t<kSlotsAtOnce == 1, const LeafPoints, const LeafPoints&>;
    const Placement from = start_.of[side], to = end_.of[side];
    const Vec3<T> at_start = in_all_lanes(Sweep::pulled_back(from, direction), T{});
    const Vec3<T> at_end = in_all_lanes(Sweep::pulled_back(to, direction), T{});
    const NodeLink leaf = tree_.link(side, node);
    PGCCD_KEEP_LOOP
    for (int32_t row = leaf.first_points; row < leaf.first_points + leaf.points_count; ++row) {
      Row eight = points(side, row);
      PGCCD_UNROLL
      for (int slot = 0; slot < kBlockWidth; slot += kSlotsAtOnce) {
        const auto vertices = [&](int end) {
          return tree_.sweep().template leaf_points<T>(tree_.bodies(), eight, side, slot, end);
        };
        out[0].include(dot(at_start, vertices(0)), row, slot);
        out[1].include(dot(at_end, vertices(1)), row, slot);
      }
    }
    if (side == 0) return;
    out[0].along = out[0].along + dot(direction, from.shift());
    out[1].along = out[1].along + dot(direction, to.shift());
  }

  PGCCD_HD Vec3<float> place(int side, const Farthest& at, bool is_start) const {
    const auto point = tree_.sweep().template leaf_points<float>(tree_.bodies(), points(side, at.row), side, at.slot,
                                                                 is_start ? 0 : 1);
    return Sweep::place((is_start ? start_ : end_).of[side], point);
  }

  const PairTree<Bodies>& tree_;
  NodePair leaves_;
  const LocalPose &start_, &end_;
  int k_;
};

// The time until which the leaves certainly stay apart, as part of the step; kNeverMeet if over the whole step.
constexpr float kNeverMeet = 2.0f;

namespace separation_detail {

// Whether the leaves certainly stay apart over segment k. Otherwise `free_part` is the first part of it in which they
// do. One function, so that the host inlines everything into it.
template <class T, class Bodies>
PGCCD_HD_RARE bool leaves_stay_apart(const PairTree<Bodies>& tree, NodePair leaves, int k, float& free_part) {
  const LeafSeparation<T, Bodies> separation(tree, leaves, k);
  Vec3<float> reached = separation.between_spheres();
  free_part = 0.0f;
  for (int step = 0; step < kSeparationSteps; ++step) {
    if (separation.is_along(reached, free_part)) return true;
  }
  return false;
}

// The time until which the leaves of a pair that turns fast stay apart, of a range of its segments.
template <class T>
PGCCD_HD_RARE float leaves_free_while_turning(const PairTree<RigidBodies>& tree, NodePair leaves, TimeSpan range) {
  SpanWalk walk(range);
  while (!walk.is_over()) {
    const SpanTree over(tree, walk.span());
    float free_part;
    if (leaves_stay_apart<T>(over.tree(), leaves, 1, free_part)) {
      walk.next();
    } else if (!walk.divide()) {
      return time_in_step(walk.span().end, free_part, tree.sweep().segment_count);
    }
  }
  return kNeverMeet;
}
template <class T>
PGCCD_HD float leaves_free_while_turning(const PairTree<DeformingBodies>&, NodePair, TimeSpan) {
  return 0.0f;
}

}  // namespace separation_detail

template <class T, class Bodies>
PGCCD_HD float leaves_free_until(const PairTree<Bodies>& tree, NodePair leaves) {
  const int segments = tree.sweep().segment_count;
  if (tree.sweep().turns_fast()) {
    return separation_detail::leaves_free_while_turning<T>(tree, leaves, {0, segments});
  }
  for (int k = 1; k <= segments; ++k) {
    float free_part;
    if (separation_detail::leaves_stay_apart<T>(tree, leaves, k, free_part)) continue;
    return separation_detail::time_in_step(k, free_part, segments);
  }
  return kNeverMeet;
}

}  // namespace pgccd
