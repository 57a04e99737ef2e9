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
    return vertices<T>(bodies, side, end, [&](int lane) { return points.vertex[slot + lane]; });
  }

  PGCCD_HD static Vec3<float> pulled_back(const Placement& p, Vec3<float> direction) { return scale_of(p) * direction; }

  template <class T>
  PGCCD_HD Corners<T> corners(const DeformingBodies& bodies, int side, int32_t triangle, int end) const {
    const int64_t first = first_face[side] + triangle;
    int64_t last = first;  // lanes beyond the last triangle repeat it
    if constexpr (sizeof(T) != sizeof(float)) last = bodies.meshes.offsets[bodies.mesh_index[body[side]] + 1].face - 1;
    Corners<T> out;
    for (int c = 0; c < 3; ++c) {
      out.corner[c] = vertices<T>(
          bodies, side, end, [&](int lane) { return bodies.meshes.triangles[smaller(first + lane, last)].vertex[c]; });
    }
    return out;
  }

 private:
  PGCCD_HD static float scale_of(const Placement& p) { return p.x.axis.x; }
  template <class T>
  PGCCD_HD Vec3<T> until_horizon(Vec3<T> at_t0, Vec3<T> at_t1) const {
    return at_t0 + static_cast<float>(horizon) * (at_t1 - at_t0);
  }
  // The vertices with numbers number(0), ..., one per lane; at the horizon to 4 units of rounding.
  template <class T, class Number>
  PGCCD_HD Vec3<T> vertices(const DeformingBodies& bodies, int side, int end, Number&& number) const {
    const int64_t first = bodies.vertex_begin[body[side]];
    const auto at_end = [&](int its_end) -> Vec3<T> {
      if constexpr (sizeof(T) == sizeof(float)) {
        return bodies.local_vertices[first + number(0)].position(its_end);
      } else {
        const float* rows[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
          rows[lane] = bodies.local_vertices[first + number(lane)].at[its_end];
        }
        return three_columns<T>(rows);
      }
    };
    if (end == 0 || horizon == 1.0) return at_end(end);
    return until_horizon(at_end(0), at_end(1));
  }
};

}  // namespace pgccd
