// A body pair as the traversal sees it, from t = 0 to a horizon: both hierarchies in one local frame that moves with
// the first body's centre, scaled by a power of two to about unit size, in float32. Time is cut into segments short
// enough for chords to follow the rotation; the inflation covers what is left of the arcs, and all float32 rounding.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "core/lanes.h"
#include "core/rounding.h"

namespace pgccd {

constexpr int kMaxSegments = 64;

// Everything is below 1 in the local frame: matrix entries, products, sums, the moving-sphere test and the separating
// directions together stay below 64 units of float32 rounding.
constexpr float kLocalRounding = 64.0f * Precision<float>::unit;

// Pairs of features are kept if they may come within separation + tolerance: what the narrow phase may report at all.
struct SweepSettings {
  double separation;
  double tolerance;  // as in pair_tolerance
};

// Poses at one segment boundary, scale included.
struct LocalPose {
  Mat3<float> first;   // body frame of i -> local
  Mat3<float> second;  // body frame of j -> local, without the shift
  Vec3<float> shift;   // centre of j
};

// Eight triangles of one body in its own frame, at one end of a segment.
template <class T>
struct Corners {
  Vec3<T> corner[3];
};

namespace sweep_detail {

PGCCD_HD double local_scale(const BodyCentres& centres, int64_t i, int64_t j, const RelativeCentre& centre) {
  const double size =
      2.0 * ((centres.radius[i] + centres.radius[j]) + larger(max_abs(centre.at_t0), max_abs(centre.at_t1)));
  return inverse_power_of_two(size);
}

PGCCD_HD double kept_distance(const BodyCentres& centres, int64_t i, int64_t j, const SweepSettings& settings) {
  return settings.separation + pair_tolerance(centres, i, j, settings.tolerance);
}

PGCCD_HD float rounded_up(double x) { return static_cast<float>(x) * (1.0f + 2.0f * Precision<float>::unit); }

PGCCD_HD Mat3<float> scaled(double scale, const Mat3<double>& m) {
  return {cast<float>(scale * m.r0), cast<float>(scale * m.r1), cast<float>(scale * m.r2)};
}

PGCCD_HD Mat3<double> blend(const Mat3<double>& m0, const Mat3<double>& m1, double t) {
  const double s = 1.0 - t;
  return {s * m0.r0 + t * m1.r0, s * m0.r1 + t * m1.r1, s * m0.r2 + t * m1.r2};
}

template <class T>
PGCCD_HD Vec3<T> transform(const Mat3<float>& m, Vec3<T> v) {
  return {(m.r0.x * v.x + m.r0.y * v.y) + m.r0.z * v.z, (m.r1.x * v.x + m.r1.y * v.y) + m.r1.z * v.z,
          (m.r2.x * v.x + m.r2.y * v.y) + m.r2.z * v.z};
}
template <class T>
PGCCD_HD Vec3<T> shifted(Vec3<float> shift, Vec3<T> v) {
  return {shift.x + v.x, shift.y + v.y, shift.z + v.z};
}

}  // namespace sweep_detail

struct RigidSweep {
  int64_t body[2];
  int32_t mesh[2];
  double scale;
  double horizon;
  float inflation;  // distance to keep, chord deviation and rounding, local units
  // By how much of |n_end - n_start|, times a node's radius, its slab is thicker along the mean of the two normals.
  // With normals n0 and n1 that belong to rotations at the ends of the segment: half, since the mean differs from each
  // by half of it. With straight vertex paths up to a horizon h, offsets at the end are blends of offsets under both
  // rotations of the whole step, n_end = n0 + h (n1 - n0) is not the normal of one, and the blend of both excesses is
  // |n1 - n0| (3/2 h - h^2) <= 3/2 |n_end - n0|.
  float tilt;
  int segment_count;

  PGCCD_HD RigidSweep(const RigidBodies& bodies, int64_t i, int64_t j, const SweepSettings& settings, double until)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]}, horizon(until) {
    const BodyCentres& centres = bodies.centres;
    scale = sweep_detail::local_scale(centres, i, j, relative_centre(centres, i, j));
    segment_count = 1;
    tilt = bodies.linear_path ? 1.5f : 0.5f;
    double deviation = 0.0;
    if (!bodies.linear_path) {
      const double ri = centres.radius[i], rj = centres.radius[j];
      const double turn_i = norm_squared(load_vec3(bodies.rotation + 3 * i));
      const double turn_j = norm_squared(load_vec3(bodies.rotation + 3 * j));
      const double bend = 0.125 * (horizon * horizon) * (turn_i * ri + turn_j * rj);
      // Chords may stray by a fiftieth of the smaller body; with the last segment count they may stray further, and
      // that is still covered.
      const double wanted = std::sqrt(bend / (0.02 * smaller(ri, rj)));
      segment_count = wanted > kMaxSegments ? kMaxSegments : (wanted > 1.0 ? static_cast<int>(std::ceil(wanted)) : 1);
      deviation = bend / (static_cast<double>(segment_count) * segment_count);
    }
    const double distance = sweep_detail::kept_distance(centres, i, j, settings) + deviation;
    inflation = sweep_detail::rounded_up(scale * distance) + kLocalRounding;
  }

  // Segment boundary k of segment_count.
  PGCCD_HD LocalPose pose(const RigidBodies& bodies, int k) const {
    const RelativeCentre centre = relative_centre(bodies.centres, body[0], body[1]);
    const double t = horizon * (static_cast<double>(k) / segment_count);
    LocalPose out;
    for (int side = 0; side < 2; ++side) {
      const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body[side]));
      const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body[side]));
      Mat3<double> at_t = at_t0;
      if (k > 0)
        at_t = bodies.linear_path ? sweep_detail::blend(at_t0, spun(spin, at_t0, 1.0), t) : spun(spin, at_t0, t);
      (side == 0 ? out.first : out.second) = sweep_detail::scaled(scale, at_t);
    }
    out.shift = cast<float>(scale * ((1.0 - t) * centre.at_t0 + t * centre.at_t1));
    return out;
  }

  PGCCD_HD const NodeBlock& block(const RigidBodies& bodies, int side, int32_t block) const {
    return bodies.meshes.node_blocks[bodies.meshes.offsets[mesh[side]].block + block];
  }
  // Body-frame centre of a node; the same at both ends of a segment.
  PGCCD_HD Vec3<float> node_centre(const RigidBodies& bodies, int side, int32_t block_index, int slot, int) const {
    const NodeBlock& b = block(bodies, side, block_index);
    return {b.x[slot], b.y[slot], b.z[slot]};
  }

  // Body frame -> local frame, at the boundary with pose p.
  template <class T>
  PGCCD_HD static Vec3<T> place(const LocalPose& p, int side, Vec3<T> v) {
    if (side == 0) return sweep_detail::transform(p.first, v);
    return sweep_detail::shifted(p.shift, sweep_detail::transform(p.second, v));
  }

  // Body-frame direction -> local frame, unit length kept.
  PGCCD_HD Vec3<float> turned(const LocalPose& p, int side, Vec3<float> direction) const {
    return static_cast<float>(1.0 / scale) * sweep_detail::transform(side == 0 ? p.first : p.second, direction);
  }

  // Of one triangle, or of it and the seven that follow.
  template <class T>
  PGCCD_HD Corners<T> corners(const RigidBodies& bodies, int side, int32_t triangle, int) const {
    const CornerColumns& columns = bodies.meshes.corners;
    const int64_t row = bodies.meshes.offsets[mesh[side]].face + triangle;
    const auto column = [&](int index) { return load<T>(columns.first + index * columns.stride + row); };
    Corners<T> out;
    for (int c = 0; c < 3; ++c) out.corner[c] = {column(3 * c), column(3 * c + 1), column(3 * c + 2)};
    return out;
  }
};

struct DeformingSweep {
  int64_t body[2];
  int32_t mesh[2];
  double scale;
  double horizon;
  float inflation;
  static constexpr float tilt = 0.0f;  // normals do not turn
  static constexpr int segment_count = 1;

  PGCCD_HD DeformingSweep(const DeformingBodies& bodies, int64_t i, int64_t j, const SweepSettings& settings,
                          double until)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]}, horizon(until) {
    scale = sweep_detail::local_scale(bodies.centres, i, j, relative_centre(bodies.centres, i, j));
    const double distance = sweep_detail::kept_distance(bodies.centres, i, j, settings);
    inflation = sweep_detail::rounded_up(scale * distance) + kLocalRounding;
  }

  PGCCD_HD LocalPose pose(const DeformingBodies& bodies, int k) const {
    const RelativeCentre centre = relative_centre(bodies.centres, body[0], body[1]);
    const double t = k == 0 ? 0.0 : horizon;
    LocalPose out{};
    out.first.r0.x = static_cast<float>(scale);  // no rotation: the scale is all there is
    out.shift = cast<float>(scale * ((1.0 - t) * centre.at_t0 + t * centre.at_t1));
    return out;
  }

  PGCCD_HD const NodeBlock& block(const DeformingBodies& bodies, int side, int32_t block) const {
    return bodies.blocks_t0[bodies.block_begin[body[side]] + block];
  }
  // Relative to the body's centre, at the start (0) or the horizon (1).
  PGCCD_HD Vec3<float> node_centre(const DeformingBodies& bodies, int side, int32_t block_index, int slot,
                                   int end) const {
    const int64_t row = bodies.block_begin[body[side]] + block_index;
    const NodeBlock& b0 = bodies.blocks_t0[row];
    const Vec3<float> at_t0{b0.x[slot], b0.y[slot], b0.z[slot]};
    if (end == 0) return at_t0;
    const NodeBlock& b1 = bodies.blocks_t1[row];
    return until_horizon(at_t0, {b1.x[slot], b1.y[slot], b1.z[slot]});
  }

  template <class T>
  PGCCD_HD static Vec3<T> place(const LocalPose& p, int side, Vec3<T> v) {
    const Vec3<T> scaled{p.first.r0.x * v.x, p.first.r0.x * v.y, p.first.r0.x * v.z};
    return side == 0 ? scaled : sweep_detail::shifted(p.shift, scaled);
  }

  PGCCD_HD Vec3<float> turned(const LocalPose&, int, Vec3<float> direction) const { return direction; }

  template <class T>
  PGCCD_HD Corners<T> corners(const DeformingBodies& bodies, int side, int32_t triangle, int end) const {
    Corners<T> out;
    if constexpr (sizeof(T) == sizeof(float)) {
      const Triangle& t = bodies.meshes.triangles[bodies.meshes.offsets[mesh[side]].face + triangle];
      for (int c = 0; c < 3; ++c) out.corner[c] = vertex(bodies, side, t.vertex[c], end);
    } else {
      const MeshOffsets* offsets = bodies.meshes.offsets + mesh[side];
      const int64_t count = offsets[1].face - offsets[0].face;
      for (int lane = 0; lane < kLanes; ++lane) {
        const int64_t row = triangle + lane < count ? triangle + lane : count - 1;
        const Triangle& t = bodies.meshes.triangles[offsets[0].face + row];
        for (int c = 0; c < 3; ++c) {
          const Vec3<float> x = vertex(bodies, side, t.vertex[c], end);
          out.corner[c].x[lane] = x.x;
          out.corner[c].y[lane] = x.y;
          out.corner[c].z[lane] = x.z;
        }
      }
    }
    return out;
  }

 private:
  PGCCD_HD Vec3<float> until_horizon(Vec3<float> at_t0, Vec3<float> at_t1) const {
    return at_t0 + static_cast<float>(horizon) * (at_t1 - at_t0);
  }
  PGCCD_HD Vec3<float> vertex(const DeformingBodies& bodies, int side, int32_t v, int end) const {
    const BodyCentres& centres = bodies.centres;
    const int64_t row = bodies.vertex_begin[body[side]] + v;
    const Vec3<double> local_t0 =
        load_vec3(bodies.vertices_t0 + 3 * row) - load_vec3(centres.position_t0 + 3 * body[side]);
    if (end == 0) return cast<float>(local_t0);
    const Vec3<double> local_t1 =
        load_vec3(bodies.vertices_t1 + 3 * row) - load_vec3(centres.position_t1 + 3 * body[side]);
    return cast<float>((1.0 - horizon) * local_t0 + horizon * local_t1);
  }
};

template <class Bodies>
struct SweepOf;
template <>
struct SweepOf<RigidBodies> {
  using type = RigidSweep;
};
template <>
struct SweepOf<DeformingBodies> {
  using type = DeformingSweep;
};

}  // namespace pgccd
