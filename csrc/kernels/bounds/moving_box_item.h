// The moving box of a body (core/moving_box.h), from the box of its mesh or, of a deforming body, its vertices.
#pragma once

#include "core/centre_arc.h"
#include "core/moving_box.h"
#include "kernels/bounds/node_bounds.h"

namespace pgccd {

namespace box_detail {

// Centre and half of the edges of a mesh's box, relative to the SBV centre, body axes; zero for a mesh without one.
PGCCD_HD Vec3<double> row_of_box(const MeshSetView& meshes, int32_t mesh, int row) {
  return load_vec3(meshes.boxes + 12 * int64_t{mesh} + 3 * row);
}

template <class Bodies>
PGCCD_HD bool mesh_has_box(const Bodies& bodies, int64_t body) {
  if (bodies.meshes.boxes == nullptr) return false;
  return norm_squared(row_of_box(bodies.meshes, bodies.mesh_index[body], 1)) > 0.0;
}

// Without a box.
PGCCD_HD MovingBox moving_point(float unit, double growth) {
  MovingBox box{};
  box.unit = unit;
  box.growth = static_cast<float>(growth);
  return box;
}

template <class Bodies>
PGCCD_HD double margin_of(const Bodies& bodies, int64_t body) {
  return bodies.centres.margin == nullptr ? 0.0 : bodies.centres.margin[body];
}

}  // namespace box_detail

// Bodies on arcs stray from the straight way between the ends by at most `arc_bulge` of the largest distance from the
// axis. Also included: the margin, the rounding of SBV centres, and what the narrow phase treats as touching (as in
// CentrePath of the traversal; the offset of the origins is at most that of the SBV centres and both reaches).
template <class Team>
PGCCD_HD MovingBox moving_box(const Team&, const RigidBodies& bodies, int64_t body) {
  const double radius = bodies.centres.radius[body];
  const float unit = static_cast<float>(radius);
  const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body));
  if (!(spin.angle <= 2.0 * kLargestAngle)) return box_detail::moving_point(unit, INFINITY);  // reported by checks
  const Vec3<double> centre = mesh_centre(bodies, body);
  const double reach = mesh_reach(bodies, body);
  const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body));
  const double point_error = (kRigidPointUnits + 8.0 * spin.angle) * Precision<double>::unit * reach;
  double fixed = box_detail::margin_of(bodies, body) + 5.0 * point_error + 1536.0 * Precision<double>::unit * reach;
  if (!is_centred(centre)) {
    const double largest = larger(max_abs(load_vec3(bodies.centres.position_t0 + 3 * body)),
                                  max_abs(load_vec3(bodies.centres.position_t1 + 3 * body)));
    fixed += centre_offset_error(spin.angle, centre) + 2.0 * Precision<double>::unit * (largest + norm(centre));
  }
  const double per_unit = 1.0 / unit, from_axis = distance_from_axis(at_t0, spin, centre);
  const auto growth = [&](double furthest) {
    const double bulge = bodies.linear_path ? 0.0 : arc_bulge(spin.angle, furthest);
    return per_unit * (bulge + fixed);
  };
  const MovingBox point = box_detail::moving_point(unit, per_unit * radius + growth(from_axis));
  if (!box_detail::mesh_has_box(bodies, body)) return point;
  const SineCosine at_t1 = sine_cosine(spin.angle);
  const auto of_box = [&](int row) {
    return at_t0 * box_detail::row_of_box(bodies.meshes, bodies.mesh_index[body], row);
  };
  const Vec3<double> middle = of_box(0);
  double furthest = norm(cross(spin.axis, at_t0 * centre + middle));
  MovingBox box{};
  box.unit = unit;
  box.centre[0] = cast<float>(per_unit * middle);
  box.centre[1] = cast<float>(per_unit * rotate(spin, at_t1, middle));
  for (int k = 0; k < 3; ++k) {
    const Vec3<double> half = of_box(1 + k);
    furthest += norm(cross(spin.axis, half));
    box.half[0][k] = cast<float>(per_unit * half);
    box.half[1][k] = cast<float>(per_unit * rotate(spin, at_t1, half));
  }
  box.growth = static_cast<float>(growth(smaller(furthest, from_axis + radius)));
  return box.is_slender() ? box : point;
}

namespace box_detail {

// Larger meshes deform without boxes, since these are measured by few threads.
constexpr int64_t kMostBoxedFaces = 8192;

PGCCD_HD Vec3<double> normalised(Vec3<double> v, double length) { return (1.0 / length) * v; }

// The first axis joins the two nodes below the root that are furthest apart, the second one leads from it to the node
// furthest from it. False if there are no such nodes.
PGCCD_HD bool choose_axes(const NodeBlock& at_t0, const NodeBlock& at_t1, Vec3<double> (&axis)[3]) {
  Vec3<double> centre[kBlockWidth];
  int count = 0;
  for (; count < kBlockWidth && at_t0.radius[count] >= 0.0f; ++count) {
    centre[count] = {double{at_t0.x[count]} + at_t1.x[count], double{at_t0.y[count]} + at_t1.y[count],
                     double{at_t0.z[count]} + at_t1.z[count]};
  }
  double longest = 0.0;
  int from = 0;
  for (int a = 0; a < count; ++a) {
    for (int b = a + 1; b < count; ++b) {
      const Vec3<double> along = centre[b] - centre[a];
      if (const double length = norm(along); length > longest) {
        longest = length;
        axis[0] = along;
        from = a;
      }
    }
  }
  if (!(longest > 0.0)) return false;
  axis[0] = normalised(axis[0], longest);
  double widest = 0x1p-10 * longest;
  // If all nodes are in a line: perpendicular to it and to the coordinate axis that is the least along it.
  const Vec3<double> a{magnitude(axis[0].x), magnitude(axis[0].y), magnitude(axis[0].z)};
  const bool is_x = a.x <= a.y && a.x <= a.z, is_y = !is_x && a.y <= a.z;
  const Vec3<double> across =
      cross(axis[0], Vec3<double>{is_x ? 1.0 : 0.0, is_y ? 1.0 : 0.0, is_x || is_y ? 0.0 : 1.0});
  axis[1] = normalised(across, norm(across));
  for (int k = 0; k < count; ++k) {
    const Vec3<double> offset = centre[k] - centre[from], aside = offset - dot(offset, axis[0]) * axis[0];
    if (const double length = norm(aside); length > widest) {
      widest = length;
      axis[1] = normalised(aside, length);
    }
  }
  axis[2] = cross(axis[0], axis[1]);
  return true;
}

}  // namespace box_detail

// The threads of a team measure a share of the vertices each, and all return the same.
template <class Team>
PGCCD_HD MovingBox moving_box(const Team& team, const DeformingBodies& bodies, int64_t body) {
  const double radius = bodies.centres.radius[body];
  const float unit = static_cast<float>(radius);
  const double per_unit = 1.0 / unit;
  const double growth = per_unit * box_detail::margin_of(bodies, body);
  const MovingBox point = box_detail::moving_point(unit, per_unit * radius + growth);
  const MeshOffsets* const rows = bodies.meshes.offsets + bodies.mesh_index[body];
  const int64_t face_count = rows[1].face - rows[0].face;
  const NodeLink root = bodies.meshes.node_links[rows[0].block * kBlockWidth];
  Vec3<double> axis[3] = {};
  if (!box_detail::mesh_has_box(bodies, body) || face_count > box_detail::kMostBoxedFaces || root.triangle_count != 0)
    return point;
  const int64_t children = bodies.block_begin[body] + root.first;
  if (!box_detail::choose_axes(bodies.blocks_t0[children], bodies.blocks_t1[children], axis)) return point;

  double low[2][3], high[2][3];
  for (int k = 0; k < 3; ++k) {
    for (int end = 0; end < 2; ++end) {
      low[end][k] = INFINITY;
      high[end][k] = -INFINITY;
    }
  }
  const int32_t* const corners = bodies.meshes.faces + 3 * rows[0].face;
  const auto corner_of = [&](int index) { return 3 * face_count * index / Team::kCount; };
  for (int64_t corner = corner_of(team.index()); corner < corner_of(team.index() + 1); ++corner) {
    const int64_t vertex = 3 * (bodies.vertex_begin[body] + corners[corner]);
    for (int end = 0; end < 2; ++end) {
      const double* const vertices = end == 0 ? bodies.vertices_t0 : bodies.vertices_t1;
      const double* const centre = end == 0 ? bodies.centres.position_t0 : bodies.centres.position_t1;
      const Vec3<double> x = per_unit * (load_vec3(vertices + vertex) - load_vec3(centre + 3 * body));
      for (int k = 0; k < 3; ++k) {
        const double along = dot(axis[k], x);
        low[end][k] = smaller(low[end][k], along);
        high[end][k] = larger(high[end][k], along);
      }
    }
  }
  MovingBox box{};
  box.unit = unit;
  box.growth = static_cast<float>(growth);
  for (int end = 0; end < 2; ++end) {
    Vec3<double> middle{0.0, 0.0, 0.0};
    for (int k = 0; k < 3; ++k) {
      const double from = refit_detail::smallest(team, low[end][k]), to = refit_detail::largest(team, high[end][k]);
      middle = middle + (0.5 * (from + to)) * axis[k];
      box.half[end][k] = cast<float>((0.5 * (to - from)) * axis[k]);
    }
    box.centre[end] = cast<float>(middle);
  }
  return box.is_slender() ? box : point;
}

}  // namespace pgccd
