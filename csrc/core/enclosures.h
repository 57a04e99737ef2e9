// Which bodies may be inside of solids at t = 0, as candidates: a vertex of each connected piece of a body, since a
// piece that meets no surface is inside or outside as a whole.
#pragma once

#include "core/candidate.h"
#include "core/centre_arc.h"

namespace pgccd {
namespace enclosures_detail {

PGCCD_HD double coordinate_sum(Vec3<double> v) { return (magnitude(v.x) + magnitude(v.y)) + magnitude(v.z); }

// From the SBV centre of a solid to a vertex of another body, world axes; and a bound of its error.
struct Offset {
  Vec3<double> value;
  double error;
};

// More than the roundings of an offset, in units of what is added.
constexpr double kRounding = 0x1p-40;

PGCCD_HD Offset offset_at_start(const RigidBodies& bodies, int64_t body, int64_t vertex, int64_t solid) {
  const auto turned = [&](int64_t of, Vec3<double> point) {
    return rotation_matrix<double>(load_quaternion(bodies.orientation + 4 * of)) * point;
  };
  const int64_t row = bodies.meshes.offsets[bodies.mesh_index[body]].vertex + vertex;
  const Vec3<double> point = turned(body, load_vec3(bodies.meshes.vertices + 3 * row));
  const Vec3<double> centre = turned(solid, mesh_centre(bodies, solid));
  const Vec3<double> between = relative_centre(bodies.centres, solid, body).at_t0;
  const double size = (coordinate_sum(point) + coordinate_sum(centre)) + coordinate_sum(between);
  return {(between + point) - centre, kRounding * size};
}

PGCCD_HD Offset offset_at_start(const DeformingBodies& bodies, int64_t body, int64_t vertex, int64_t solid) {
  const Vec3<double> point = load_vec3(bodies.vertices_t0 + 3 * (bodies.vertex_begin[body] + vertex));
  const Vec3<double> offset = point - load_vec3(bodies.centres.position_t0 + 3 * solid);
  return {offset, kRounding * coordinate_sum(offset)};
}

}  // namespace enclosures_detail

// Whether a vertex is within the SBV of a solid at t = 0.
template <class Bodies>
PGCCD_HD bool may_be_inside(const Bodies& bodies, int64_t body, int64_t vertex, int64_t solid) {
  const enclosures_detail::Offset offset = enclosures_detail::offset_at_start(bodies, body, vertex, solid);
  const double reach = bodies.centres.radius[solid] + offset.error;
  return norm_squared(offset.value) <= reach * reach * (1.0 + enclosures_detail::kRounding);
}

// Calls use(candidate) for one vertex of each piece of both bodies of a pair that may be inside of the other, a solid.
template <class Bodies, class Use>
PGCCD_HD void for_each_enclosure(const Bodies& bodies, const int64_t* pairs, int64_t row, Use&& use) {
  const SolidColumns& solids = bodies.meshes.solids;
  const int64_t pair[2] = {pairs[2 * row], pairs[2 * row + 1]};
  if (pair[0] == pair[1]) return;
  PGCCD_KEEP_LOOP
  for (int side = 0; side < 2; ++side) {
    if (!is_solid(bodies.meshes, bodies.mesh_index[pair[1 - side]])) continue;
    const int32_t mesh = bodies.mesh_index[pair[side]];
    const auto kind = static_cast<int32_t>(side == 0 ? FeatureKind::kInside : FeatureKind::kContains);
    PGCCD_KEEP_LOOP
    for (int64_t piece = solids.piece_begin[mesh]; piece < solids.piece_begin[mesh + 1]; ++piece) {
      const int32_t vertex = solids.vertex[piece];
      if (!may_be_inside(bodies, pair[side], vertex, pair[1 - side])) continue;
      use(Candidate{static_cast<int32_t>(row), kind, side == 0 ? vertex : 0, side == 0 ? 0 : vertex});
    }
  }
}

}  // namespace pgccd
