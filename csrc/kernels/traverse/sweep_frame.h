// A body pair in the traversal, from t = 0 to a horizon: both hierarchies in one local frame that moves with the first
// body's SBV centre, scaled by a power of two to about unit size, in float32. Time is divided into segments short
// enough for chords to follow the rotation; the inflation covers the deviation of the arcs, and all float32 rounding.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "core/lanes.h"
#include "core/rounding.h"
#include "core/trig.h"

namespace pgccd {

// Poses at the boundaries of up to so many segments are stored; of more they are computed where they are needed.
constexpr int kStoredSegments = 64;

// Everything is below 1 in the local frame: matrix entries, products, sums, the moving-sphere test and the separating
// directions together stay below 64 units of float32 rounding.
constexpr float kLocalRounding = 64.0f * Precision<float>::unit;

// Pairs of features are kept if they may come within separation + tolerance, which the narrow phase may report; with
// `tests_start` also edges and faces that may pass through one another at t = 0.
struct SweepSettings {
  double separation;
  double tolerance;  // as in pair_tolerance
  bool tests_start;
  bool divides_time = true;  // false: no pair turns fast, see time_spans.h; pairs that would are tested less closely
};

// The pose of a body in the local frame, scale included: a point v relative to its SBV centre, body axes, is at
// rows . v + shift. Rows are loaded and copied 16 bytes at a time.
struct alignas(16) PlacementRow {
  Vec3<float> axis;
  float shift;
};
struct Placement {
  PlacementRow x, y, z;

  PGCCD_HD Vec3<float> shift() const { return {x.shift, y.shift, z.shift}; }
};

// The poses of both bodies at one segment boundary. The shift of the first is zero.
struct LocalPose {
  Placement of[2];
};

// Eight triangles of one body in its own frame, at one end of a segment.
template <class T>
struct Corners {
  Vec3<T> corner[3];
};

namespace sweep_detail {

// Range of scales and their inverses in float. In smaller pairs all distances are within the rounding allowed in the
// local frame, so nothing is dropped. In pairs so far apart that the scale is smaller, the bodies vanish in the local
// frame (their radii are at most 1e30), and slabs are not used.
constexpr double kSmallestSize = 0x1p-126;
constexpr double kSmallestScale = 0x1p-126;

PGCCD_HD double largest_coordinate(const RelativeCentre& centre) {
  return larger(max_abs(centre.at_t0), max_abs(centre.at_t1));
}

// `offset`: no coordinate of one SBV centre relative to the other is larger during the step.
PGCCD_HD double local_scale(const BodyCentres& centres, int64_t i, int64_t j, double offset) {
  const double size = 2.0 * ((centres.radius[i] + centres.radius[j]) + offset);
  return inverse_power_of_two(larger(size, kSmallestSize));
}

PGCCD_HD double kept_distance(const BodyCentres& centres, int64_t i, int64_t j, const SweepSettings& settings) {
  return pair_separation(centres, i, j, settings.separation) + pair_tolerance(centres, i, j, settings.tolerance);
}

// For bodies that turn by this angle; of invalid poses no more than of others. Below 2^24: exact as floats.
PGCCD_HD double most_segments(double angle, bool divides_time = true) {
  constexpr double kPerRadian = 16.0;
  static_assert(kPerRadian * kLargestAngle < 0x1p24);
  return divides_time && angle <= kLargestAngle ? larger(kPerRadian * angle, static_cast<double>(kStoredSegments))
                                                : kStoredSegments;
}

PGCCD_HD float rounded_up(double x) { return static_cast<float>(x) * (1.0f + 2.0f * Precision<float>::unit); }

// Edges and faces that are further apart at t = 0, in the local frame, certainly do not pass through one another: all
// float32 rounding, and that of the centres. Negative if starts are not tested.
PGCCD_HD float start_distance(const SweepSettings& settings, double centre_rounding) {
  return settings.tests_start ? rounded_up(centre_rounding) + kLocalRounding : -1.0f;
}

PGCCD_HD Placement scaled(double scale, const Mat3<double>& m) {
  return {{cast<float>(scale * m.r0), 0.0f}, {cast<float>(scale * m.r1), 0.0f}, {cast<float>(scale * m.r2), 0.0f}};
}
PGCCD_HD void set_shift(Placement& p, Vec3<float> shift) {
  p.x.shift = shift.x;
  p.y.shift = shift.y;
  p.z.shift = shift.z;
}

PGCCD_HD Mat3<double> blend(const Mat3<double>& m0, const Mat3<double>& m1, double t) {
  const double s = 1.0 - t;
  return {s * m0.r0 + t * m1.r0, s * m0.r1 + t * m1.r1, s * m0.r2 + t * m1.r2};
}

// Without the shift.
template <class T>
PGCCD_HD Vec3<T> turned(const Placement& p, Vec3<T> v) {
  const auto row = [&](Vec3<float> r) { return multiply_add(r.z, v.z, multiply_add(r.y, v.y, r.x * v.x)); };
  return {row(p.x.axis), row(p.y.axis), row(p.z.axis)};
}
// The sum of a vector under two poses, without their shifts.
PGCCD_HD Vec3<float> turned_by_sum(const Placement& p, const Placement& q, Vec3<float> v) {
  return {dot(p.x.axis + q.x.axis, v), dot(p.y.axis + q.y.axis, v), dot(p.z.axis + q.z.axis, v)};
}
template <class T>
PGCCD_HD Vec3<T> shifted(const Placement& p, Vec3<T> v) {
  return {p.x.shift + v.x, p.y.shift + v.y, p.z.shift + v.z};
}

// First row of the node blocks of a body's hierarchy; deforming bodies have their own, at t0.
PGCCD_HD const NodeBlock* first_block(const RigidBodies& bodies, int64_t, const MeshOffsets& offsets) {
  return bodies.meshes.node_blocks + offsets.block;
}
PGCCD_HD const NodeBlock* first_block(const DeformingBodies& bodies, int64_t body, const MeshOffsets&) {
  return bodies.blocks_t0 + bodies.block_begin[body];
}

}  // namespace sweep_detail

// Members shared by both kinds of sweeps: the first rows of the bodies' hierarchies (read at every node), their frame,
// and the scale. Sweeps are copied 16 bytes at a time.
struct PairFrame {
  int64_t body[2];
  int64_t first_face[2];  // in the mesh set
  const NodeLink* links[2];
  const NodeBlock* blocks[2];
  const LeafPoints* leaf_rows[2];
  double scale;  // a power of two
  double horizon;
  float local_scale, inverse_scale;  // the same in float, perhaps 0; and 1 / scale, or 0 beyond the range of float

  template <class Bodies>
  PGCCD_HD PairFrame(const Bodies& bodies, int64_t i, int64_t j, double until, double offset)
      : body{i, j}, horizon(until) {
    scale = sweep_detail::local_scale(bodies.centres, i, j, offset);
    local_scale = static_cast<float>(scale);
    inverse_scale = scale < sweep_detail::kSmallestScale ? 0.0f : static_cast<float>(1.0 / scale);
    for (int side = 0; side < 2; ++side) {
      const MeshOffsets& offsets = bodies.meshes.offsets[bodies.mesh_index[body[side]]];
      first_face[side] = offsets.face;
      links[side] = bodies.meshes.node_links + offsets.block * kBlockWidth;
      blocks[side] = sweep_detail::first_block(bodies, body[side], offsets);
      leaf_rows[side] = bodies.meshes.leaf_points + offsets.leaf_points;
    }
  }
};

}  // namespace pgccd
