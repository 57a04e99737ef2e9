// Bounding volume hierarchy of a mesh: a tree of spheres in blocks of eight siblings over its triangles; built once, in
// the body frame.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/mesh_set.h"
#include "mesh/topology.h"

namespace pgccd {

struct Hierarchy {
  std::vector<NodeBlock> blocks;
  std::vector<std::array<NodeLink, kBlockWidth>> links;
  std::vector<std::array<NodeSupport, kBlockWidth>> supports;
  std::vector<int32_t> triangle_order;  // faces in the order of the leaves
  std::vector<LeafPoints> leaf_points;
};

// `vertices`: x, y, z rows. Splits at the minimum of the surface area heuristic (Goldsmith & Salmon 1987); in the
// middle once the tree is deep, so that its depth stays within kMaxTreeDepth.
Hierarchy build_hierarchy(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces, int leaf_size);

}  // namespace pgccd
