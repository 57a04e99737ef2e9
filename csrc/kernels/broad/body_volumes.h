// Continuous bounding volumes for the broad phase: swept spheres. Together with `boxes_may_meet` (box_item.h), for
// bodies that fill little of their SBV, a single predicate decides the PCS, `is_potentially_colliding`; a broad phase
// may only skip pairs for which it is certainly false, so all of them return the same pairs.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "core/moving_box.h"
#include "core/rounding.h"

namespace pgccd {

struct BroadBodies {
  int64_t count;
  BodyCentres centres;
  const int64_t* group;            // (count,) bits, or null: all bits
  const int64_t* mask;             // (count,) bits, or null: all bits
  const int32_t* world;            // (count,) or null: one world
  const uint8_t* is_static;        // (count,) 0 or 1, or null: none
  const uint8_t* in_other_search;  // (count,) nonzero: another search finds the pairs of these bodies; null: none
  double separation;
  double tolerance;  // as in pair_tolerance
  // Nonzero if the input is invalid, which the host has not read yet; no pairs are then found. May be null.
  const int64_t* is_invalid = nullptr;
  // Whether pairs are found that may meet if each body is stopped or slowed down on its way: at two times of their
  // whole paths, equal or not.
  bool at_any_times = false;
  const MovingBox* boxes = nullptr;  // (count,) or null: every body fills much of its SBV

  PGCCD_HD bool invalid() const { return is_invalid != nullptr && *is_invalid != 0; }
  // Padding rows have a negative radius. No broad phase pairs them, and they reach no cell.
  PGCCD_HD bool is_absent(int64_t body) const { return centres.radius[body] < 0.0; }
};

PGCCD_HD bool may_collide(const BroadBodies& bodies, int64_t i, int64_t j) {
  if (bodies.world && bodies.world[i] != bodies.world[j]) return false;
  if (bodies.is_static && bodies.is_static[i] && bodies.is_static[j]) return false;
  if (bodies.in_other_search && bodies.in_other_search[i] && bodies.in_other_search[j]) return false;
  const int64_t all = ~int64_t{0};
  const int64_t group_i = bodies.group ? bodies.group[i] : all, group_j = bodies.group ? bodies.group[j] : all;
  const int64_t mask_i = bodies.mask ? bodies.mask[i] : all, mask_j = bodies.mask ? bodies.mask[j] : all;
  return (group_i & mask_j) != 0 && (group_j & mask_i) != 0;
}

// Smaller distances may underflow when squared, and count as zero.
constexpr double kVanishing = 0x1p-500;

// Radius of a CBV grown by half of separation + tolerance, and by the rounding of the predicate below. A tolerance
// relative to the smaller radius is at most that relative to this one.
PGCCD_HD double swept_reach(const BroadBodies& bodies, int64_t body, Vec3<double> travel) {
  const double radius = bodies.centres.radius[body];
  const double kept = bodies.separation + (bodies.tolerance < 0.0 ? -bodies.tolerance * radius : bodies.tolerance);
  return (radius + 0.5 * kept) * (1.0 + 0x1p-40) + 0x1p-40 * max_abs(travel) + kVanishing;
}

// The box of a swept sphere. Its ends are rounded to world coordinates, monotonically: exact boxes that overlap also
// overlap as computed, and tests that compare ends keep them.
struct SweptBox {
  Vec3<double> lower, upper;
};

// The middle of a computed box differs from the exact one by at most a quarter of a unit in the last place of its
// largest end on each of three axes, if the body is smaller than 2^-20 of that end. The centres are then multiples of
// the spacing S of doubles at the outer end or, across a power of two, of S / 2. With equal spacing, both ends are
// rounded outward, or inward, by the same amount. With S at one end and S / 2 at the other, centre + reach rounded to S
// and centre - reach rounded to S / 2 differ from mirror images by at most S / 2.
constexpr double kBoxRounding = 1.7320508075688774 * 0x1p-54;

PGCCD_HD SweptBox swept_box(const BroadBodies& bodies, int64_t body) {
  if (bodies.invalid()) return {};  // avoids NaN
  const Vec3<double> p0 = load_vec3(bodies.centres.position_t0 + 3 * body);
  const Vec3<double> p1 = load_vec3(bodies.centres.position_t1 + 3 * body);
  const double reach = swept_reach(bodies, body, p1 - p0);
  const Vec3<double> r{reach, reach, reach};
  return {Vec3<double>{smaller(p0.x, p1.x), smaller(p0.y, p1.y), smaller(p0.z, p1.z)} - r,
          Vec3<double>{larger(p0.x, p1.x), larger(p0.y, p1.y), larger(p0.z, p1.z)} + r};
}

PGCCD_HD bool overlap(const SweptBox& a, const SweptBox& b) {
  return a.lower.x <= b.upper.x && b.lower.x <= a.upper.x && a.lower.y <= b.upper.y && b.lower.y <= a.upper.y &&
         a.lower.z <= b.upper.z && b.lower.z <= a.upper.z;
}

namespace predicate_detail {

PGCCD_HD double kept_distance(const BroadBodies& bodies, int64_t i, int64_t j) {
  return bodies.separation + pair_tolerance(bodies.centres, i, j, bodies.tolerance);
}

PGCCD_HD bool meet_at_equal_times(const BroadBodies& bodies, int64_t i, int64_t j) {
  const RelativeCentre offset = relative_centre(bodies.centres, i, j);
  const Vec3<double> travel = offset.at_t1 - offset.at_t0;
  const double length_squared = norm_squared(travel);
  double nearest = 0.0;
  if (length_squared > 0.0) nearest = unit_clamp(-dot(offset.at_t0, travel) / length_squared);
  // Offsets, travel and the point at `nearest` each have a few roundings of the larger offset; an error of `nearest`
  // has a second-order effect only.
  const double rounding = 0x1p-48 * (max_abs(offset.at_t0) + max_abs(offset.at_t1)) + kVanishing;
  const double kept = kept_distance(bodies, i, j);
  // 2^-42: the narrow phase computes points of the bodies to within kRigidPointUnits.
  const double reach = (bodies.centres.radius[i] + bodies.centres.radius[j] + kept) * (1.0 + 0x1p-42) + rounding;
  return !(norm_squared(offset.at_t0 + nearest * travel) > reach * reach);
}

PGCCD_HD double half_travel(const BodyCentres& centres, int64_t body) {
  return 0.5 * norm(load_vec3(centres.position_t1 + 3 * body) - load_vec3(centres.position_t0 + 3 * body));
}

// By the spheres around whole paths, and the boxes around these paths. Boxes of a pair that meets overlap, so no broad
// phase skips it, and the rank with the lower corner of their intersection holds both bodies and finds it.
// A slowed body is on its path only up to the rounding of its positions; but rounding is monotone, so it stays in the
// box between the ends of the whole path, and the sphere with the path as its diameter contains that box. Offsets near
// `reach` are at most twice as long, so 2^-41 includes their rounding; being twice the 2^-42 of equal times, it lets in
// every pair that meets at those.
PGCCD_HD bool meet_at_any_times(const BroadBodies& bodies, int64_t i, int64_t j) {
  if (!overlap(swept_box(bodies, i), swept_box(bodies, j))) return false;
  const RelativeCentre offset = relative_centre(bodies.centres, i, j);
  const double half_paths = half_travel(bodies.centres, i) + half_travel(bodies.centres, j);
  const double radii = bodies.centres.radius[i] + bodies.centres.radius[j];
  const double reach = (radii + kept_distance(bodies, i, j) + half_paths) * (1.0 + 0x1p-41) + 2.0 * kVanishing;
  return !(norm_squared(0.5 * (offset.at_t0 + offset.at_t1)) > reach * reach);
}

}  // namespace predicate_detail

// True if the moving spheres come within separation + tolerance (what the narrow phase may report) at some time of the
// step; with `at_any_times`, if they may at two times. Never false if they do in exact arithmetic. Requires i < j,
// since the order affects the last bit.
PGCCD_HD bool spheres_may_meet(const BroadBodies& bodies, int64_t i, int64_t j) {
  if (!may_collide(bodies, i, j) || bodies.is_absent(i) || bodies.is_absent(j)) return false;
  return bodies.at_any_times ? predicate_detail::meet_at_any_times(bodies, i, j)
                             : predicate_detail::meet_at_equal_times(bodies, i, j);
}

PGCCD_HD double component(Vec3<double> v, int axis) { return axis == 0 ? v.x : (axis == 1 ? v.y : v.z); }

// Float32 bounds relative to the scene's origin, rounded outward by more than the error of subtraction and conversion,
// and by less than 2^-21 of their magnitude.
PGCCD_HD double outward(double x) { return 0x1p-22 * std::fabs(x) + 0x1p-130; }
PGCCD_HD float float_below(double x) { return static_cast<float>(x - outward(x)); }
PGCCD_HD float float_above(double x) { return static_cast<float>(x + outward(x)); }

}  // namespace pgccd
