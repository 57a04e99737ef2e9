// Bounds of bodies that deform: the SBV of a step, and spheres of the hierarchy's nodes at both ends of it. One radius
// serves both ends: by convexity it then serves every blend between them.
#pragma once

#include "core/mesh_set.h"
#include "core/rounding.h"

namespace pgccd {

// One body's vertices at t0 and t1 (world) and its centre there.
struct BodyShape {
  const double* vertices[2];
  Vec3<double> centre[2];

  PGCCD_HD Vec3<double> local(int end, int32_t vertex) const {
    return load_vec3(vertices[end] + 3 * int64_t(vertex)) - centre[end];
  }
};

// Mean of the corner coordinates over all triangles (Du, Liu & Suzumura 2017, Eq. 1), summed in face order.
PGCCD_HD Vec3<double> mean_corner(const int32_t* faces, int64_t face_count, const double* vertices) {
  Vec3<double> sum{0.0, 0.0, 0.0};
  for (int64_t f = 0; f < face_count; ++f) {
    for (int corner = 0; corner < 3; ++corner) sum = sum + load_vec3(vertices + 3 * int64_t(faces[3 * f + corner]));
  }
  return (1.0 / (3.0 * static_cast<double>(face_count))) * sum;
}

// What a node covers, at both ends of the step, relative to the body's centre.
struct NodeBounds {
  Vec3<double> lower[2], upper[2];
  Vec3<float> centre[2];
  double radius;
  int32_t first_triangle, triangle_count;
};

namespace refit_detail {

PGCCD_HD Vec3<double> smaller(Vec3<double> a, Vec3<double> b) {
  return {std::fmin(a.x, b.x), std::fmin(a.y, b.y), std::fmin(a.z, b.z)};
}
PGCCD_HD Vec3<double> larger(Vec3<double> a, Vec3<double> b) {
  return {std::fmax(a.x, b.x), std::fmax(a.y, b.y), std::fmax(a.z, b.z)};
}
PGCCD_HD void place_centres(NodeBounds& node) {
  for (int end = 0; end < 2; ++end) node.centre[end] = cast<float>(0.5 * (node.lower[end] + node.upper[end]));
}

// Largest distance of the node's vertices from its centre, at either end.
PGCCD_HD double exact_radius(const BodyShape& shape, const Triangle* triangles, const NodeBounds& node) {
  double squared = 0.0;
  for (int32_t k = node.first_triangle; k < node.first_triangle + node.triangle_count; ++k) {
    for (int corner = 0; corner < 3; ++corner) {
      for (int end = 0; end < 2; ++end) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]);
        squared = std::fmax(squared, norm_squared(x - cast<double>(node.centre[end])));
      }
    }
  }
  return std::sqrt(squared);
}

}  // namespace refit_detail

PGCCD_HD NodeBounds leaf_bounds(const BodyShape& shape, const Triangle* triangles, NodeLink link) {
  NodeBounds node{};
  node.first_triangle = link.first;
  node.triangle_count = link.triangle_count;
  for (int end = 0; end < 2; ++end) {
    node.lower[end] = node.upper[end] = shape.local(end, triangles[link.first].vertex[0]);
    for (int32_t k = link.first; k < link.first + link.triangle_count; ++k) {
      for (int corner = 0; corner < 3; ++corner) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]);
        node.lower[end] = refit_detail::smaller(node.lower[end], x);
        node.upper[end] = refit_detail::larger(node.upper[end], x);
      }
    }
  }
  refit_detail::place_centres(node);
  node.radius = refit_detail::exact_radius(shape, triangles, node);
  return node;
}

// Small nodes measure their vertices; large ones take the better of two bounds, the box's corner and the children's
// spheres.
PGCCD_HD NodeBounds parent_bounds(const BodyShape& shape, const Triangle* triangles, const NodeBounds& left,
                                  const NodeBounds& right) {
  constexpr int32_t kMeasured = 32;
  NodeBounds node{};
  node.first_triangle = left.first_triangle;
  node.triangle_count = left.triangle_count + right.triangle_count;
  for (int end = 0; end < 2; ++end) {
    node.lower[end] = refit_detail::smaller(left.lower[end], right.lower[end]);
    node.upper[end] = refit_detail::larger(left.upper[end], right.upper[end]);
  }
  refit_detail::place_centres(node);
  if (node.triangle_count <= kMeasured) {
    node.radius = refit_detail::exact_radius(shape, triangles, node);
    return node;
  }
  double by_children = 0.0, by_box = 0.0;
  for (int end = 0; end < 2; ++end) {
    const Vec3<double> centre = cast<double>(node.centre[end]);
    by_children = std::fmax(by_children, norm(cast<double>(left.centre[end]) - centre) + left.radius);
    by_children = std::fmax(by_children, norm(cast<double>(right.centre[end]) - centre) + right.radius);
    by_box = std::fmax(by_box, norm(refit_detail::larger(node.upper[end] - centre, centre - node.lower[end])));
  }
  node.radius = std::fmin(by_children, by_box);
  return node;
}

PGCCD_HD NodeSphere node_sphere(const NodeBounds& node, int end) {
  const float radius = static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit);
  return {node.centre[end].x, node.centre[end].y, node.centre[end].z, radius};
}

}  // namespace pgccd
