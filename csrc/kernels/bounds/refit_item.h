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

// The mean of the corner coordinates over all triangles (Du, Liu & Suzumura 2017, Eq. 1) is summed in chunks of so many faces, and then
// over the chunks, always in order: the same bits however many threads share the work.
constexpr int64_t kMeanChunk = 256;

PGCCD_HD Vec3<double> corner_sum(const int32_t* faces, int64_t face_count, int64_t chunk, const double* vertices) {
  Vec3<double> sum{0.0, 0.0, 0.0};
  const int64_t end = smaller((chunk + 1) * kMeanChunk, face_count);
  for (int64_t f = chunk * kMeanChunk; f < end; ++f) {
    for (int corner = 0; corner < 3; ++corner) sum = sum + load_vec3(vertices + 3 * int64_t(faces[3 * f + corner]));
  }
  return sum;
}

// Number of used slots: they come first.
PGCCD_HD int used_slots(const NodeLink* links, int64_t block) {
  int count = 0;
  while (count < kBlockWidth && (links[block * kBlockWidth + count].first | links[block * kBlockWidth + count].triangle_count)) {
    ++count;
  }
  return count;
}

// What a node covers, at both ends of the step, relative to the body's centre.
struct NodeBounds {
  Vec3<double> lower[2], upper[2];
  Vec3<float> centre[2];
  double radius;
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

// Largest distance of the node's vertices from its centre, at either end.
PGCCD_HD double exact_radius(const BodyShape& shape, const Triangle* triangles, const NodeBounds& node) {
  double squared = 0.0;
  for (int32_t k = node.first_triangle; k < node.first_triangle + node.triangle_count; ++k) {
    for (int corner = 0; corner < 3; ++corner) {
      for (int end = 0; end < 2; ++end) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]);
        squared = larger(squared, norm_squared(x - cast<double>(node.centre[end])));
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
        node.lower[end] = refit_detail::lower_corner(node.lower[end], x);
        node.upper[end] = refit_detail::upper_corner(node.upper[end], x);
      }
    }
  }
  refit_detail::place_centres(node);
  node.radius = refit_detail::exact_radius(shape, triangles, node);
  return node;
}

// Small nodes measure their vertices; large ones take the better of two bounds, the box's corner and the children's spheres.
PGCCD_HD NodeBounds parent_bounds(const BodyShape& shape, const Triangle* triangles, const NodeBounds* children, int count) {
  constexpr int32_t kMeasured = 32;
  NodeBounds node = children[0];
  for (int c = 1; c < count; ++c) {
    node.triangle_count += children[c].triangle_count;
    for (int end = 0; end < 2; ++end) {
      node.lower[end] = refit_detail::lower_corner(node.lower[end], children[c].lower[end]);
      node.upper[end] = refit_detail::upper_corner(node.upper[end], children[c].upper[end]);
    }
  }
  refit_detail::place_centres(node);
  if (node.triangle_count <= kMeasured) {
    node.radius = refit_detail::exact_radius(shape, triangles, node);
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
  return node;
}

PGCCD_HD void store_node(const NodeBounds& node, int end, int slot, NodeBlock& block) {
  block.x[slot] = node.centre[end].x;
  block.y[slot] = node.centre[end].y;
  block.z[slot] = node.centre[end].z;
  block.radius[slot] = static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit);
}

PGCCD_HD void store_empty(int slot, NodeBlock& block) {
  block.x[slot] = block.y[slot] = block.z[slot] = block.radius[slot] = NAN;
}

// The nodes of one block, once the blocks below it are done, and their spheres at both ends.
PGCCD_HD void refit_block(const BodyShape& shape, const Triangle* triangles, const NodeLink* links, int64_t block,
                          NodeBounds* nodes, NodeBlock* at_t0, NodeBlock* at_t1) {
  const int count = used_slots(links, block);
  for (int slot = 0; slot < kBlockWidth; ++slot) {
    if (slot >= count) {
      store_empty(slot, *at_t0);
      store_empty(slot, *at_t1);
      continue;
    }
    const int64_t n = block * kBlockWidth + slot;
    const NodeLink link = links[n];
    nodes[n] = link.triangle_count > 0 ? leaf_bounds(shape, triangles, link)
                                       : parent_bounds(shape, triangles, nodes + int64_t(link.first) * kBlockWidth,
                                                       used_slots(links, link.first));
    store_node(nodes[n], 0, slot, *at_t0);
    store_node(nodes[n], 1, slot, *at_t1);
  }
}

}  // namespace pgccd
