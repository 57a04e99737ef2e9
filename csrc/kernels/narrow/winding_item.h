// How often the surface of a solid winds about a vertex of another body at t = 0.
#pragma once

#include "kernels/narrow/pair_points.h"

namespace pgccd {
namespace winding_detail {

// The ray from a vertex in direction +x, in the frame of the solid's node volumes.
struct Ray {
  Vec3<double> start, direction;
  double error;  // of offsets from the start
};

// Any rounding of the frame is far below it.
constexpr double kFrameRounding = 0x1p-40;

PGCCD_HD Ray ray_from(const RigidBodies& bodies, const RigidPair& pair, int side, int64_t vertex) {
  const int solid = 1 - side;
  const Vec3<double> shift = side == 0 ? pair.centre.at_t0 : -pair.centre.at_t0;
  const int64_t row = bodies.meshes.offsets[pair.mesh[side]].vertex + vertex;
  const Vec3<double> point = pair.orientation[side] * load_vec3(bodies.meshes.vertices + 3 * row);
  const Vec3<double> offset = point - shift;
  const Mat3<double>& m = pair.orientation[solid];
  const Vec3<double> turned_back = offset.x * m.r0 + offset.y * m.r1 + offset.z * m.r2;
  const double size = sum_of_magnitudes(shift) + sum_of_magnitudes(point) + mesh_reach(bodies, pair.body[solid]);
  return {turned_back - mesh_centre(bodies, pair.body[solid]), m.r0, kFrameRounding * size};
}

PGCCD_HD Ray ray_from(const DeformingBodies& bodies, const DeformingPair& pair, int side, int64_t vertex) {
  const int64_t solid = pair.body[1 - side];
  const double* point = bodies.vertices_t0 + 3 * (bodies.vertex_begin[pair.body[side]] + vertex);
  const Vec3<double> start = load_vec3(point) - load_vec3(bodies.centres.position_t0 + 3 * solid);
  return {start, {1.0, 0.0, 0.0}, kFrameRounding * (sum_of_magnitudes(start) + bodies.centres.radius[solid])};
}

PGCCD_HD const NodeBlock* blocks_at_start(const RigidBodies& bodies, int64_t body) {
  return bodies.meshes.node_blocks + bodies.meshes.offsets[bodies.mesh_index[body]].block;
}
PGCCD_HD const NodeBlock* blocks_at_start(const DeformingBodies& bodies, int64_t body) {
  return bodies.blocks_t0 + bodies.block_begin[body];
}

// Whether a ray may meet the sphere of a node. False for an empty slot.
PGCCD_HD bool may_meet_node(const Ray& ray, const NodeBlock& block, int slot) {
  const Vec3<double> offset = cast<double>(Vec3<float>{block.x[slot], block.y[slot], block.z[slot]}) - ray.start;
  const double reach = static_cast<double>(block.radius[slot]) + ray.error;
  return dot(ray.direction, offset) >= -reach && norm_squared(cross(ray.direction, offset)) <= reach * reach;
}

using crossing_detail::Sign;

// The signs that decide how a ray passes a triangle: of a point 0 and corners 2 to 4, as in EdgeAndFace.
template <class Fine>
class PassingRay {
 public:
  // `fine()`: the points in double-double.
  PGCCD_HD PassingRay(const EdgeAndFace<double>& given, double point_error, const Fine& fine)
      : given_(given), error_(point_error), fine_(fine) {}

  // 1 where the ray leaves through the triangle, -1 where it enters, 0 where it misses it. It starts at (x, y + e, z +
  // e^2) with an infinitely small e > 0, so it meets no vertex and no edge, and passes each point of a closed surface
  // once.
  PGCCD_HD int turn() {
    bool is_above[3];
    for (int k = 0; k < 3; ++k) is_above[k] = above(2 + k);
    int turn = 0;  // of the boundary about the ray: its edges that pass the height of the ray on the side of +y
    for (int k = 0; k < 3; ++k) {
      const int next = k == 2 ? 0 : k + 1;
      if (is_above[k] == is_above[next]) continue;
      const Sign upwards = is_above[next] ? Sign::kPositive : Sign::kNegative;
      if (side_of(2 + k, 2 + next) == upwards) turn += static_cast<int>(upwards);
    }
    // The line meets the triangle at x + volume / (normal along x).
    return turn != 0 && static_cast<int>(volume()) == turn ? turn : 0;
  }

 private:
  PGCCD_HD const EdgeAndFace<DoubleDouble>& points() {
    if (!has_points_) points_ = fine_();
    has_points_ = true;
    return points_;
  }

  PGCCD_HD bool above(int corner) {
    const double height = given_.point[corner].z - given_.point[0].z;
    if (magnitude(height) > 4.0 * error_) return height > 0.0;
    return points().point[corner].z > points().point[0].z;
  }

  PGCCD_HD Sign volume() {
    const int at[4] = {0, 2, 3, 4};
    const double scale = crossing_detail::scale_of(size_of(given_));
    const Sign found = crossing_detail::certain_sign(given_, error_, scale, at);
    if (found != Sign::kOpen) return found;
    return crossing_detail::sign_of(crossing_detail::exact_volume_of(points(), scale, at));
  }

  // The sign of the area of the point and two corners, seen along x.
  PGCCD_HD Sign side_of(int from, int to) {
    const double size = size_of(given_);
    if (!(size > 0.0)) return Sign::kZero;
    const double scale = crossing_detail::scale_of(size);
    const int at[4] = {0, 1, from, to};
    const Sign found = crossing_detail::certain_sign(seen_along_x(given_, size), error_, scale, at);
    if (found != Sign::kOpen) return found;
    const auto flat = seen_along_x(points(), DoubleDouble(size));
    return crossing_detail::sign_of(crossing_detail::exact_volume_of(flat, scale, at));
  }

  // All in one plane, but point 1, before point 0.
  template <class T>
  PGCCD_HD static EdgeAndFace<T> seen_along_x(EdgeAndFace<T> x, T size) {
    x.point[1] = x.point[0];
    for (int k = 0; k < 5; ++k) x.point[k].x = T(0);
    x.point[1].x = size;
    return x;
  }

  const EdgeAndFace<double>& given_;
  const double error_;
  const Fine& fine_;
  EdgeAndFace<DoubleDouble> points_;  // once they are needed
  bool has_points_ = false;
};

}  // namespace winding_detail

// How often the closed surface of the other body winds about a vertex of one, side 0 or 1 of a pair: 0 outside. Exact
// for the points of `fine()`, the pair with points in higher precision.
template <class Bodies, class Pair, class Fine>
PGCCD_HD_RARE int winding_number(const Bodies& bodies, const Pair& pair, const Fine& fine, int side, int64_t vertex) {
  using namespace winding_detail;
  const int64_t solid = pair.body[1 - side];
  const MeshOffsets& rows = bodies.meshes.offsets[pair.mesh[1 - side]];
  const Ray ray = ray_from(bodies, pair, side, vertex);
  const NodeBlock* blocks = blocks_at_start(bodies, solid);
  const NodeLink* links = bodies.meshes.node_links + rows.block * kBlockWidth;
  int32_t stack[kMaxTreeDepth * (kBlockWidth - 1) + 1] = {0};
  int size = 1, winding = 0;
  while (size > 0) {
    const int32_t block = stack[--size];
    PGCCD_KEEP_LOOP
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const NodeLink link = links[block * kBlockWidth + slot];
      if (link.triangle_count < 0 || !may_meet_node(ray, blocks[block], slot)) continue;
      if (link.triangle_count == 0) stack[size++] = link.first;
      PGCCD_KEEP_LOOP
      for (int k = 0; k < link.triangle_count; ++k) {
        const int64_t face = bodies.meshes.triangles[rows.face + link.first + k].face;
        const int32_t* corner = bodies.meshes.faces + 3 * (rows.face + face);
        const CrossingVertices named{{vertex, vertex}, {corner[0], corner[1], corner[2]}, side == 1};
        const EdgeAndFace<double> given = pair.edge_and_face(bodies, named);
        const auto points = [&] { return in_double_double(fine().edge_and_face(bodies, named)); };
        winding += PassingRay(given, pair.point_error, points).turn();
      }
    }
  }
  return winding;
}

}  // namespace pgccd
