// Bounds of deforming bodies: the SBV of a step, and spheres of the hierarchy's nodes at both ends of it, with one
// radius. By convexity they bound the nodes at every interpolated time.
#pragma once

#include "core/mesh_set.h"
#include "core/rounding.h"

namespace pgccd {

// One body's vertices at t0 and t1 (world), and its centres.
struct BodyShape {
  const double* vertices[2];
  Vec3<double> centre[2];

  PGCCD_HD Vec3<double> local(int end, int32_t vertex) const {
    return load_vec3(vertices[end] + 3 * int64_t(vertex)) - centre[end];
  }
};

// The mean of the corner coordinates over all triangles (Du, Liu & Suzumura 2017, Eq. 1) is summed in chunks of this
// many faces, then over the chunks, always in order: bitwise equal for any number of threads.
constexpr int64_t kMeanChunk = 256;

PGCCD_HD Vec3<double> corner_sum(const int32_t* faces, int64_t face_count, int64_t chunk, const double* vertices) {
  Vec3<double> sum{0.0, 0.0, 0.0};
  const int64_t end = smaller((chunk + 1) * kMeanChunk, face_count);
  for (int64_t f = chunk * kMeanChunk; f < end; ++f) {
    for (int corner = 0; corner < 3; ++corner) sum = sum + load_vec3(vertices + 3 * int64_t(faces[3 * f + corner]));
  }
  return sum;
}

// Number of used slots, which come first.
PGCCD_HD int used_slots(const NodeLink* links, int64_t block) {
  int count = 0;
  while (count < kBlockWidth && links[block * kBlockWidth + count].triangle_count >= 0) ++count;
  return count;
}

// Bounds of a node at both ends of the step, relative to the body's centre.
struct NodeBounds {
  Vec3<double> lower[2], upper[2];
  Vec3<float> centre[2];
  double radius;
  Vec3<double> area_normal;  // sum of the triangles' cross products over both ends
  Vec3<float> normal;
  double low[2], high[2];  // along the normal, from the centres
  int32_t first_triangle, triangle_count;
};

namespace refit_detail {

PGCCD_HD Vec3<double> lower_corner(Vec3<double> a, Vec3<double> b) {
  return {smaller(a.x, b.x), smaller(a.y, b.y), smaller(a.z, b.z)};
}
PGCCD_HD Vec3<double> upper_corner(Vec3<double> a, Vec3<double> b) {
  return {larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)};
}
PGCCD_HD void place_centres(NodeBounds& node) {
  for (int end = 0; end < 2; ++end) node.centre[end] = cast<float>(0.5 * (node.lower[end] + node.upper[end]));
}

// Sphere and slab from the node's own vertices.
PGCCD_HD void measure(const BodyShape& shape, const Triangle* triangles, NodeBounds& node) {
  double squared = 0.0;
  for (int end = 0; end < 2; ++end) {
    node.low[end] = INFINITY;
    node.high[end] = -INFINITY;
  }
  for (int32_t k = node.first_triangle; k < node.first_triangle + node.triangle_count; ++k) {
    for (int corner = 0; corner < 3; ++corner) {
      for (int end = 0; end < 2; ++end) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]) - cast<double>(node.centre[end]);
        squared = larger(squared, norm_squared(x));
        const double along = dot(cast<double>(node.normal), x);
        node.low[end] = smaller(node.low[end], along);
        node.high[end] = larger(node.high[end], along);
      }
    }
  }
  node.radius = std::sqrt(squared);
}

PGCCD_HD void set_normal(NodeBounds& node) {
  const double length = norm(node.area_normal);
  node.normal = length > 0.0 ? cast<float>((1.0 / length) * node.area_normal) : Vec3<float>{0.0f, 0.0f, 1.0f};
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
        node.lower[end] = refit_detail::lower_corner(node.lower[end], x);
        node.upper[end] = refit_detail::upper_corner(node.upper[end], x);
      }
    }
  }
  for (int32_t k = link.first; k < link.first + link.triangle_count; ++k) {
    for (int end = 0; end < 2; ++end) {
      const Vec3<double> p = shape.local(end, triangles[k].vertex[0]);
      const Vec3<double> a = shape.local(end, triangles[k].vertex[1]) - p,
                         b = shape.local(end, triangles[k].vertex[2]) - p;
      node.area_normal = node.area_normal + cross(a, b);
    }
  }
  refit_detail::place_centres(node);
  refit_detail::set_normal(node);
  refit_detail::measure(shape, triangles, node);
  return node;
}

// Small nodes measure their vertices; large ones take the smaller of two bounds, from the box's corner and from the
// children's spheres.
PGCCD_HD NodeBounds parent_bounds(const BodyShape& shape, const Triangle* triangles, const NodeBounds* children,
                                  int count) {
  constexpr int32_t kMeasured = 32;
  NodeBounds node = children[0];
  for (int c = 1; c < count; ++c) {
    node.triangle_count += children[c].triangle_count;
    node.area_normal = node.area_normal + children[c].area_normal;
    for (int end = 0; end < 2; ++end) {
      node.lower[end] = refit_detail::lower_corner(node.lower[end], children[c].lower[end]);
      node.upper[end] = refit_detail::upper_corner(node.upper[end], children[c].upper[end]);
    }
  }
  refit_detail::place_centres(node);
  refit_detail::set_normal(node);
  if (node.triangle_count <= kMeasured) {
    refit_detail::measure(shape, triangles, node);
    return node;
  }
  double by_children = 0.0, by_box = 0.0;
  for (int end = 0; end < 2; ++end) {
    const Vec3<double> centre = cast<double>(node.centre[end]);
    for (int c = 0; c < count; ++c) {
      by_children = larger(by_children, norm(cast<double>(children[c].centre[end]) - centre) + children[c].radius);
    }
    by_box = larger(by_box, norm(refit_detail::upper_corner(node.upper[end] - centre, centre - node.lower[end])));
  }
  node.radius = smaller(by_children, by_box);
  for (int end = 0; end < 2; ++end) {
    node.low[end] = -node.radius;
    node.high[end] = node.radius;
  }
  return node;
}

PGCCD_HD void store_node(const NodeBounds& node, int end, int slot, NodeBlock& block) {
  block.x[slot] = node.centre[end].x;
  block.y[slot] = node.centre[end].y;
  block.z[slot] = node.centre[end].z;
  block.radius[slot] = static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit);
  block.normal_x[slot] = node.normal.x;
  block.normal_y[slot] = node.normal.y;
  block.normal_z[slot] = node.normal.z;
  // One slab for both ends, widened by more than the rounding of the projections.
  const double slack = 0x1p-22 * node.radius;
  block.low[slot] = static_cast<float>(smaller(node.low[0], node.low[1]) - slack);
  block.high[slot] = static_cast<float>(larger(node.high[0], node.high[1]) + slack);
}

PGCCD_HD void store_empty(int slot, NodeBlock& block) {
  block.x[slot] = block.y[slot] = block.z[slot] = block.radius[slot] = NAN;
  block.normal_x[slot] = block.normal_y[slot] = block.normal_z[slot] = block.low[slot] = block.high[slot] = NAN;
}

// Computes one node from the finished block below it, and stores its spheres at both ends; or stores an empty slot.
PGCCD_HD void refit_node(const BodyShape& shape, const Triangle* triangles, const NodeLink* links, int64_t block,
                         int slot, NodeBounds* nodes, NodeBlock* at_t0, NodeBlock* at_t1) {
  if (slot >= used_slots(links, block)) {
    store_empty(slot, *at_t0);
    store_empty(slot, *at_t1);
    return;
  }
  const int64_t n = block * kBlockWidth + slot;
  const NodeLink link = links[n];
  nodes[n] = link.triangle_count > 0 ? leaf_bounds(shape, triangles, link)
                                     : parent_bounds(shape, triangles, nodes + int64_t(link.first) * kBlockWidth,
                                                     used_slots(links, link.first));
  store_node(nodes[n], 0, slot, *at_t0);
  store_node(nodes[n], 1, slot, *at_t1);
}

}  // namespace pgccd
