// A pair of deforming bodies in its local frame.
#pragma once

#include "kernels/traverse/sweep_frame.h"

namespace pgccd {

struct alignas(16) DeformingSweep : PairFrame {
  float inflation;
  float start_distance;
  const NodeBlock* blocks_at_t1[2];
  static constexpr int segment_count = 1;

  PGCCD_HD DeformingSweep(const DeformingBodies& bodies, int64_t i, int64_t j, const SweepSettings& settings,
                          double until, int /*least_segments*/ = 1)
      : PairFrame(bodies, i, j, until, sweep_detail::largest_coordinate(relative_centre(bodies.centres, i, j))) {
    for (int side = 0; side < 2; ++side) blocks_at_t1[side] = bodies.blocks_t1 + bodies.block_begin[body[side]];
    const double distance = sweep_detail::kept_distance(bodies.centres, i, j, settings);
    inflation = sweep_detail::rounded_up(scale * distance) + kLocalRounding;
    start_distance = sweep_detail::start_distance(settings, 0.0);
  }

  // In a test of a body against itself both sides are one tree, and only one of two mirror images is needed.
  static constexpr bool may_be_one_body = true;
  static constexpr bool has_supports = false;
  PGCCD_HD bool is_one_body() const { return body[0] == body[1]; }
  static constexpr bool may_turn_fast = false;
  PGCCD_HD static constexpr bool turns_fast() { return false; }
  PGCCD_HD static constexpr int last_pose() { return segment_count; }

  PGCCD_HD LocalPose pose(const DeformingBodies& bodies, int k) const {
    const RelativeCentre centre = relative_centre(bodies.centres, body[0], body[1]);
    const double t = k == 0 ? 0.0 : horizon;
    LocalPose out{};
    for (Placement& placement : out.of) placement.x.axis.x = static_cast<float>(scale);  // no rotation
    sweep_detail::set_shift(out.of[1], cast<float>(scale * ((1.0 - t) * centre.at_t0 + t * centre.at_t1)));
    return out;
  }

  // Relative to the body's centre, at the start (0) or the horizon (1).
  PGCCD_HD Vec3<float> node_centre(int side, int32_t block, int slot, int end) const {
    const NodeBlock& b0 = blocks[side][block];
    const Vec3<float> at_t0{b0.x[slot], b0.y[slot], b0.z[slot]};
    if (end == 0) return at_t0;
    const NodeBlock& b1 = blocks_at_t1[side][block];
    return until_horizon(at_t0, {b1.x[slot], b1.y[slot], b1.z[slot]});
  }

  template <class T>
  PGCCD_HD static Vec3<T> place(const Placement& p, Vec3<T> v) {
    return sweep_detail::shifted(p, scale_of(p) * v);
  }

  // Normals do not rotate.
  PGCCD_HD static Vec3<float> mean_of_turned(const Placement&, const Placement&, Vec3<float> normal) { return normal; }
  PGCCD_HD static constexpr float slab_growth(int) { return 0.0f; }

  // One of eight vertices of a leaf, or (T = Float8) all eight; relative to the body's centre, at the start (0) or the
  // horizon (1).
  template <class T>
  PGCCD_HD Vec3<T> leaf_points(const DeformingBodies& bodies, const LeafPoints& points, int side, int slot,
                               int end) const {
    if constexpr (sizeof(T) == sizeof(float)) {
      return vertex(bodies, side, points.vertex[slot], end);
    } else {
      Vec3<T> out;
      for (int lane = 0; lane < kLanes; ++lane) {
        const Vec3<float> x = vertex(bodies, side, points.vertex[lane], end);
        out.x[lane] = x.x;
        out.y[lane] = x.y;
        out.z[lane] = x.z;
      }
      return out;
    }
  }

  PGCCD_HD static Vec3<float> pulled_back(const Placement& p, Vec3<float> direction) { return scale_of(p) * direction; }

  template <class T>
  PGCCD_HD Corners<T> corners(const DeformingBodies& bodies, int side, int32_t triangle, int end) const {
    Corners<T> out;
    if constexpr (sizeof(T) == sizeof(float)) {
      const Triangle& t = bodies.meshes.triangles[first_face[side] + triangle];
      for (int c = 0; c < 3; ++c) out.corner[c] = vertex(bodies, side, t.vertex[c], end);
    } else {
      const MeshOffsets* offsets = bodies.meshes.offsets + bodies.mesh_index[body[side]];
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
  PGCCD_HD static float scale_of(const Placement& p) { return p.x.axis.x; }
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

}  // namespace pgccd
