// Which bodies may be inside of solids at t = 0, as candidates: a vertex of each connected piece of a body, since a
// piece that meets no surface is inside or outside as a whole.
#pragma once

#include "core/candidate.h"
#include "core/centre_arc.h"

namespace pgccd {
namespace enclosures_detail {

// From the SBV centre of a solid to a point of another body, world axes; and a bound of its error.
struct Offset {
  Vec3<double> value;
  double error;
};

// More than the roundings of an offset, in units of what is added.
constexpr double kRounding = 0x1p-40;

// A body and a solid at t = 0.
template <class Bodies>
struct AtStart;

template <>
struct AtStart<RigidBodies> {
  const RigidBodies& bodies;
  int64_t body;
  Mat3<double> turn;
  Vec3<double> centre_of_solid, between;

  PGCCD_HD AtStart(const RigidBodies& all, int64_t of, int64_t solid) : bodies(all), body(of) {
    const auto matrix = [&](int64_t each) {
      return rotation_matrix<double>(load_quaternion(bodies.orientation + 4 * each));
    };
    turn = matrix(body);
    centre_of_solid = matrix(solid) * mesh_centre(bodies, solid);
    between = relative_centre(bodies.centres, solid, body).at_t0;
  }

  PGCCD_HD Offset vertex(int64_t row) const {
    return point(load_vec3(bodies.meshes.vertices + 3 * (bodies.meshes.offsets[bodies.mesh_index[body]].vertex + row)));
  }
  PGCCD_HD const NodeBlock* blocks() const {
    return bodies.meshes.node_blocks + bodies.meshes.offsets[bodies.mesh_index[body]].block;
  }
  PGCCD_HD Offset node(Vec3<double> centre) const { return point(mesh_centre(bodies, body) + centre); }

 private:
  PGCCD_HD Offset point(Vec3<double> of_mesh) const {
    const Vec3<double> turned = turn * of_mesh;
    const double size = (sum_of_magnitudes(turned) + sum_of_magnitudes(centre_of_solid)) + sum_of_magnitudes(between);
    return {(between + turned) - centre_of_solid, kRounding * size};
  }
};

template <>
struct AtStart<DeformingBodies> {
  const DeformingBodies& bodies;
  int64_t body;
  Vec3<double> centre_of_solid;

  PGCCD_HD AtStart(const DeformingBodies& all, int64_t of, int64_t solid)
      : bodies(all), body(of), centre_of_solid(load_vec3(all.centres.position_t0 + 3 * solid)) {}

  PGCCD_HD Offset vertex(int64_t row) const {
    return point(load_vec3(bodies.vertices_t0 + 3 * (bodies.vertex_begin[body] + row)));
  }
  PGCCD_HD const NodeBlock* blocks() const { return bodies.blocks_t0 + bodies.block_begin[body]; }
  PGCCD_HD Offset node(Vec3<double> centre) const {
    return point(load_vec3(bodies.centres.position_t0 + 3 * body) + centre);
  }

 private:
  PGCCD_HD Offset point(Vec3<double> at) const {
    const Vec3<double> offset = at - centre_of_solid;
    return {offset, kRounding * (sum_of_magnitudes(offset) + sum_of_magnitudes(at))};
  }
};

PGCCD_HD bool is_near(const Offset& offset, double reach) {
  const double most = reach + offset.error;
  return norm_squared(offset.value) <= most * most * (1.0 + kRounding);
}

// Calls use(vertex) for the points of a body, found by its hierarchy, that are within a distance of the centre of a
// solid: a cloud has too many to look at each.
template <class Bodies, class Use>
PGCCD_HD_RARE void for_each_point_near(const AtStart<Bodies>& at, double reach, Use&& use) {
  const Bodies& bodies = at.bodies;
  const MeshOffsets& rows = bodies.meshes.offsets[bodies.mesh_index[at.body]];
  const NodeBlock* const blocks = at.blocks();
  const NodeLink* const links = bodies.meshes.node_links + rows.block * kBlockWidth;
  int32_t stack[kMaxTreeDepth * (kBlockWidth - 1) + 1] = {0};
  int size = 1;
  while (size > 0) {
    const int32_t block = stack[--size];
    PGCCD_KEEP_LOOP
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const NodeLink link = links[block * kBlockWidth + slot];
      const NodeBlock& b = blocks[block];
      if (link.triangle_count < 0) continue;
      const Vec3<double> centre{b.x[slot], b.y[slot], b.z[slot]};
      if (!is_near(at.node(centre), reach + b.radius[slot])) continue;
      if (link.triangle_count == 0) {
        stack[size++] = link.first;
        continue;
      }
      PGCCD_KEEP_LOOP
      for (int k = 0; k < link.triangle_count; ++k) {
        const Triangle& element = bodies.meshes.triangles[rows.face + link.first + k];
        if (element.kind() != ElementKind::kPoint) break;
        if (is_near(at.vertex(element.vertex[0]), reach)) use(element.vertex[0]);
      }
    }
  }
}

}  // namespace enclosures_detail

// Calls use(candidate) for one vertex of each piece of both bodies of a pair that may be inside of the other, a solid:
// that is within its SBV at t = 0.
template <class Bodies, class Use>
PGCCD_HD void for_each_enclosure(const Bodies& bodies, const int64_t* pairs, int64_t row, Use&& use) {
  const SolidColumns& solids = bodies.meshes.solids;
  const int64_t pair[2] = {pairs[2 * row], pairs[2 * row + 1]};
  if (pair[0] == pair[1]) return;
  PGCCD_KEEP_LOOP
  for (int side = 0; side < 2; ++side) {
    const int64_t body = pair[side], solid = pair[1 - side];
    if (!is_solid(bodies.meshes, bodies.mesh_index[solid])) continue;
    const enclosures_detail::AtStart<Bodies> at(bodies, body, solid);
    const double reach = bodies.centres.radius[solid];
    const int32_t mesh = bodies.mesh_index[body];
    const auto kind = static_cast<int32_t>(side == 0 ? FeatureKind::kInside : FeatureKind::kContains);
    const auto use_vertex = [&](int32_t vertex) {
      use(Candidate{static_cast<int32_t>(row), kind, side == 0 ? vertex : 0, side == 0 ? 0 : vertex});
    };
    PGCCD_KEEP_LOOP
    for (int64_t piece = solids.piece_begin[mesh]; piece < solids.piece_begin[mesh + 1]; ++piece) {
      const int32_t vertex = solids.vertex[piece];
      if (enclosures_detail::is_near(at.vertex(vertex), reach)) use_vertex(vertex);
    }
    if (has_points(bodies.meshes, mesh)) enclosures_detail::for_each_point_near(at, reach, use_vertex);
  }
}

}  // namespace pgccd
