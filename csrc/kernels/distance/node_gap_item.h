// Lower bounds of the distance of two nodes over a part of the step.
#pragma once

#include "kernels/distance/moving_pair.h"
#include "kernels/traverse/support_item.h"

namespace pgccd {

// Part `index` of 2^level equal parts of the step.
struct TimePart {
  int32_t level, index;

  PGCCD_HD double length() const { return std::ldexp(1.0, -level); }
  PGCCD_HD double begin() const { return index * length(); }
  PGCCD_HD double at(double fraction) const { return (index + fraction) * length(); }
  PGCCD_HD bool operator==(const TimePart& other) const { return level == other.level && index == other.index; }
};

// The least value of first (1 - s)^2 + 2 middle s (1 - s) + last s^2 for s from 0 to 1.
PGCCD_HD double least_of_quadratic(double first, double middle, double last) {
  const double fall = first - middle, rise = last - middle;
  if (!(fall > 0.0 && rise > 0.0)) return smaller(first, last);
  return first - fall * (fall / (fall + rise));
}

// The least value that a function has between two times, given its values there and a bound of (length^2 / 2) f''
// between them: it is at least (1 - s) first + s last - bend s (1 - s).
PGCCD_HD double least_between(double first, double last, double bend) {
  return least_of_quadratic(first, 0.5 * ((first + last) - bend), last);
}

// The point nearest to zero of the segment between two points.
PGCCD_HD Vec3<double> nearest_to_zero(Vec3<double> from, Vec3<double> to) {
  const Vec3<double> travel = to - from;
  const double squared = norm_squared(travel);
  const double s = squared > 0.0 ? unit_clamp(-dot(from, travel) / squared) : 0.0;
  return from + s * travel;
}

// A pair over a part of the step: at both of its ends, or at one time if the pair stands still.
template <class Pair>
struct PairOver {
  typename Pair::Pose pose[2];
  int ends;
  double half_square;  // of the part's length
  double length;
  double apart;  // a lower bound of the distance of any two points, however fast the bodies turn

  PGCCD_HD PairOver(const Pair& pair, TimePart part)
      : pose{pair.pose(part.begin()), pair.is_still() ? pair.pose(0.0) : pair.pose(part.at(1.0))},
        ends(pair.is_still() ? 1 : 2),
        half_square(0.5 * part.length() * part.length()),
        length(part.length()),
        apart(norm(nearest_to_zero(pose[0].shift, pose[1].shift)) - (pair.reach() + pair.rounding())) {}

  // By how much the offset of any two points strays from its chord at most.
  PGCCD_HD double deviation(const Pair& pair) const { return 0.25 * half_square * pair.curvature() * kRoundedUp; }

  // As in `least_between`, for the gap of any points of both bodies along a unit direction from the first to the
  // second. A point at r from its body's axis, of angular speed w, has x'' = -w^2 r. `most(side, end, across)`: an
  // upper bound, at both ends, of across . (x - reference point), where `across` is perpendicular to the axis, or the
  // opposite for the second body.
  template <class Most>
  PGCCD_HD double bend_along(const Pair& pair, Vec3<double> d, Most&& most) const {
    if constexpr (Pair::kIsRigid) {
      double curvature = 0.0, rounding = 0.0;
      for (int side = 0; side < 2; ++side) {
        const Spin spin = pair.spin(side);
        if (!(spin.angle > 0.0)) continue;
        const Vec3<double> across = (side == 0 ? 1.0 : -1.0) * (d - dot(d, spin.axis) * spin.axis);
        const double outwards = larger(most(side, 0, across), most(side, 1, across));
        // Between the ends r turns by at most half of the part's angle.
        const double turned = 0.5 * spin.angle * length * pair.from_axis(side) * norm(across);
        curvature += spin.angle * spin.angle * (outwards + turned);
        rounding += spin.angle * spin.angle * pair.rounding();
      }
      return half_square * larger(curvature + rounding, 0.0) * kRoundedUp;
    } else {
      return 0.0;
    }
  }

  static constexpr double kRoundedUp = 1.0 + 0x1p-40;
};

// A node of one body, and its centre at both ends.
struct NodeOver {
  int32_t node;
  double radius;
  Vec3<double> centre[2];
  Vec3<double> normal;  // body frame
  double low, high;
};

template <class Pair>
PGCCD_HD NodeOver node_over(const Pair& pair, const PairOver<Pair>& over, int side, int32_t node) {
  const int32_t block = node / kBlockWidth;
  const int slot = node % kBlockWidth;
  const NodeBlock& b = pair.blocks(side)[block];
  NodeOver out;
  out.node = node;
  out.radius = b.radius[slot];
  for (int end = 0; end < over.ends; ++end) out.centre[end] = pair.node_centre(over.pose[end], side, block, slot);
  out.normal = {b.normal_x[slot], b.normal_y[slot], b.normal_z[slot]};
  out.low = b.low[slot];
  out.high = b.high[slot];
  return out;
}

namespace gap_detail {

// How far vertices of the node reach from its centre in direction e of the body, |e| <= 1 but for rounding: the least
// of the bounds by its sphere, its slab, and for rigid bodies its support samples.
template <class Pair>
PGCCD_HD double reach_of_node(const Pair& pair, int side, const NodeOver& node, Vec3<double> e) {
  const double along = dot(e, node.normal);
  const Vec3<double> across = e - along * node.normal;
  const double of_slab = (along > 0.0 ? along * node.high : along * node.low) + norm(across) * node.radius;
  double reach = smaller(norm(e) * node.radius, of_slab);
  if constexpr (Pair::kIsRigid) {
    const MeshSetView& meshes = pair.bodies().meshes;
    const int64_t first = (pair.blocks(side) - meshes.node_blocks) * kBlockWidth;
    const int32_t* const words = meshes.node_supports[first + node.node].rows[0];
    // Rounding of the direction to float, of its place in a cell and of the interpolation: below 32 units of the
    // radius (docs/explanation/exactness.md).
    constexpr double kRounding = 32.0 * Precision<float>::unit;
    const float steps = support_detail::bound(cast<float>(e), [&](int32_t word) { return load_at(words, word); });
    const double of_samples = (double{kSupportStep} * steps + kRounding) * node.radius;
    reach = smaller(of_samples, reach);
  }
  return reach;
}

}  // namespace gap_detail

// A lower bound of the gap of two nodes along a unit direction.
template <class Pair>
PGCCD_HD double gap_along(const Pair& pair, const PairOver<Pair>& over, const NodeOver (&nodes)[2], Vec3<double> d) {
  double gap[2];
  for (int end = 0; end < over.ends; ++end) {
    const auto& pose = over.pose[end];
    const double apart = dot(d, nodes[1].centre[end] - nodes[0].centre[end]);
    const double reach = gap_detail::reach_of_node(pair, 0, nodes[0], pair.pulled_back(pose, 0, d)) +
                         gap_detail::reach_of_node(pair, 1, nodes[1], pair.pulled_back(pose, 1, -d));
    gap[end] = apart - reach;
  }
  if (over.ends == 1) return gap[0] - pair.rounding();
  const double bend = over.bend_along(pair, d, [&](int side, int end, Vec3<double> across) {
    const Vec3<double> from_origin = nodes[side].centre[end] - Pair::reference_point(over.pose[end], side);
    return dot(across, from_origin) + norm(across) * nodes[side].radius;
  });
  return least_between(gap[0], gap[1], bend) - pair.rounding();
}

// The nodes stay at least this far apart. Stops once the bound is `enough`. `hint`: a direction that may separate them,
// or zero.
template <class Pair>
PGCCD_HD double distance_bound(const Pair& pair, const PairOver<Pair>& over, const NodeOver (&nodes)[2], double enough,
                               Vec3<double> hint) {
  const Vec3<double> start = nodes[1].centre[0] - nodes[0].centre[0];
  const Vec3<double> nearest = over.ends == 2 ? nearest_to_zero(start, nodes[1].centre[1] - nodes[0].centre[1]) : start;
  const double length = norm(nearest);
  const double of_spheres = (length - (nodes[0].radius + nodes[1].radius)) - (over.deviation(pair) + pair.rounding());
  double bound = larger(of_spheres, over.apart);
  if (bound >= enough) return bound;
  const auto along = [&](Vec3<double> d) { bound = larger(gap_along(pair, over, nodes, d), bound); };
  if (max_abs(hint) > 0.0) along(hint);
  if (bound >= enough || !(length > 0.0)) return bound;
  const Vec3<double> d = (1.0 / length) * nearest;
  along(d);
  for (int side = 0; side < 2 && !(bound >= enough); ++side) {
    const Vec3<double> n = pair.turned(over.pose[0], side, nodes[side].normal);
    const double n_length = norm(n);
    if (n_length > 0.0) along((dot(n, d) < 0.0 ? -1.0 / n_length : 1.0 / n_length) * n);
  }
  return bound;
}

}  // namespace pgccd
