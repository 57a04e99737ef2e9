// A body pair as the traversal sees it: both hierarchies in one local frame that moves with the first body's centre,
// scaled by a power of two to about unit size, in float32. Time is cut into segments short enough for chords to follow
// the rotation; the inflation covers what is left of the arcs, and all float32 rounding.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "core/rounding.h"

namespace pgccd {

constexpr int kMaxSegments = 64;

// Everything is below 1 in the local frame: matrix entries, products, sums, the moving-sphere test and the separating
// directions together stay below 64 units of float32 rounding.
constexpr float kLocalRounding = 64.0f * Precision<float>::unit;

// Poses at one segment boundary, scale included.
struct LocalPose {
  Mat3<float> first;   // body frame of i -> local
  Mat3<float> second;  // body frame of j -> local, without the shift
  Vec3<float> shift;   // centre of j
};

namespace sweep_detail {

PGCCD_HD double local_scale(const BodyCentres& centres, int64_t i, int64_t j, const RelativeCentre& centre) {
  const double size =
      2.0 * ((centres.radius[i] + centres.radius[j]) + larger(max_abs(centre.at_t0), max_abs(centre.at_t1)));
  return inverse_power_of_two(size);
}

PGCCD_HD float rounded_up(double x) { return static_cast<float>(x) * (1.0f + 2.0f * Precision<float>::unit); }

PGCCD_HD Mat3<float> scaled(double scale, const Mat3<double>& m) {
  return {cast<float>(scale * m.r0), cast<float>(scale * m.r1), cast<float>(scale * m.r2)};
}

}  // namespace sweep_detail

struct RigidSweep {
  int64_t body[2];
  int32_t mesh[2];
  double scale;
  float inflation;  // separation, chord deviation and rounding, local units
  int segment_count;

  PGCCD_HD RigidSweep(const RigidBodies& bodies, int64_t i, int64_t j, double separation)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]} {
    const BodyCentres& centres = bodies.centres;
    scale = sweep_detail::local_scale(centres, i, j, relative_centre(centres, i, j));
    segment_count = 1;
    double deviation = 0.0;
    if (!bodies.linear_path) {
      const double ri = centres.radius[i], rj = centres.radius[j];
      const double bend = (norm_squared(load_vec3(bodies.rotation + 3 * i)) * ri +
                           norm_squared(load_vec3(bodies.rotation + 3 * j)) * rj) *
                          0.125;
      // Chords may stray by a fiftieth of the smaller body; beyond the last segment count they stray further, and are
      // still covered.
      const double wanted = std::sqrt(bend / (0.02 * smaller(ri, rj)));
      segment_count = wanted > kMaxSegments ? kMaxSegments : (wanted > 1.0 ? static_cast<int>(std::ceil(wanted)) : 1);
      deviation = bend / (static_cast<double>(segment_count) * segment_count);
    }
    inflation = sweep_detail::rounded_up(scale * (separation + deviation)) + kLocalRounding;
  }

  // Segment boundary k of segment_count.
  PGCCD_HD LocalPose pose(const RigidBodies& bodies, int k) const {
    const RelativeCentre centre = relative_centre(bodies.centres, body[0], body[1]);
    const double t = static_cast<double>(k) / segment_count;
    LocalPose out;
    for (int side = 0; side < 2; ++side) {
      const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body[side]));
      const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body[side]));
      (side == 0 ? out.first : out.second) = sweep_detail::scaled(scale, k == 0 ? at_t0 : spun(spin, at_t0, t));
    }
    out.shift = cast<float>(scale * ((1.0 - t) * centre.at_t0 + t * centre.at_t1));
    return out;
  }

  // Centres of the eight nodes of a block are body-frame points; `end` (0 start, 1 end of the segment) does not change them.
  PGCCD_HD const NodeBlock& block(const RigidBodies& bodies, int side, int32_t block, int /*end*/) const {
    return bodies.meshes.node_blocks[bodies.meshes.offsets[mesh[side]].block + block];
  }
  PGCCD_HD float node_scale() const { return static_cast<float>(scale); }

  // Body frame -> local frame, at the boundary with pose p.
  PGCCD_HD static Vec3<float> place(const LocalPose& p, int side, Vec3<float> v) {
    return side == 0 ? p.first * v : p.shift + p.second * v;
  }
  PGCCD_HD Vec3<float> vertex(const RigidBodies& bodies, const LocalPose& p, int /*k*/, int side, int32_t v) const {
    const int64_t row = bodies.meshes.offsets[mesh[side]].vertex + v;
    return place(p, side, cast<float>(load_vec3(bodies.meshes.vertices + 3 * row)));
  }
};

struct DeformingSweep {
  int64_t body[2];
  int32_t mesh[2];
  double scale;
  float inflation;
  static constexpr int segment_count = 1;

  PGCCD_HD DeformingSweep(const DeformingBodies& bodies, int64_t i, int64_t j, double separation)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]} {
    scale = sweep_detail::local_scale(bodies.centres, i, j, relative_centre(bodies.centres, i, j));
    inflation = sweep_detail::rounded_up(scale * separation) + kLocalRounding;
  }

  PGCCD_HD LocalPose pose(const DeformingBodies& bodies, int k) const {
    const RelativeCentre centre = relative_centre(bodies.centres, body[0], body[1]);
    LocalPose out{};
    out.first.r0.x = static_cast<float>(scale);  // no rotation: the scale is all there is
    out.shift = cast<float>(scale * (k == 0 ? centre.at_t0 : centre.at_t1));
    return out;
  }
  PGCCD_HD const NodeBlock& block(const DeformingBodies& bodies, int side, int32_t block, int end) const {
    return (end == 0 ? bodies.blocks_t0 : bodies.blocks_t1)[bodies.block_begin[body[side]] + block];
  }
  PGCCD_HD float node_scale() const { return static_cast<float>(scale); }

  PGCCD_HD static Vec3<float> place(const LocalPose& p, int side, Vec3<float> v) {
    return side == 0 ? p.first.r0.x * v : p.shift + p.first.r0.x * v;
  }
  PGCCD_HD Vec3<float> vertex(const DeformingBodies& bodies, const LocalPose& p, int k, int side, int32_t v) const {
    const BodyCentres& centres = bodies.centres;
    const int64_t row = bodies.vertex_begin[body[side]] + v;
    const Vec3<double> x = load_vec3((k == 0 ? bodies.vertices_t0 : bodies.vertices_t1) + 3 * row);
    const Vec3<double> origin = load_vec3((k == 0 ? centres.position_t0 : centres.position_t1) + 3 * body[side]);
    return place(p, side, cast<float>(x - origin));
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
