// A binary tree over the triangles of a mesh, as it is before its nodes are folded into blocks.
#pragma once

#include <cstdint>
#include <vector>

#include "core/mesh_set.h"
#include "core/vec3.h"
#include "mesh/topology.h"

namespace pgccd {

// A sphere, and the extent of the points within it along the normal.
struct NodeVolume {
  Vec3<float> centre, normal;
  float radius, low, high;
};

struct BinaryNode {
  int32_t begin, end;                          // places in triangle_order
  int32_t child;                               // first of two consecutive nodes, or -1: a leaf
  int32_t first_points = 0, points_count = 0;  // of leaves
  NodeVolume volume{};
};

struct BinaryTree {
  std::vector<BinaryNode> nodes;        // parents precede children
  std::vector<int32_t> triangle_order;  // faces in the order of the leaves
  std::vector<LeafPoints> leaf_points;
};

// Splits as build_hierarchy says.
BinaryTree build_binary_tree(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces,
                             int leaf_size);

}  // namespace pgccd
