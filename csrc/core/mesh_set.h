// Read-only views of meshes that bodies share. Body frame; rows of all meshes concatenated; indices are local to a
// mesh.
#pragma once

#include <cstdint>

#include "core/vec3.h"

namespace pgccd {

// One triangle, in the order of the hierarchy's leaves. Every vertex and every edge of a mesh is *represented* by
// exactly one of its triangles (representative triangles, Curtis, Tamstorf & Manocha 2008), so that a feature pair is
// emitted once.
struct Triangle {
  int32_t vertex[3];
  int32_t edge[3];      // edge k joins vertex k and vertex (k + 1) % 3
  int32_t face;         // row in the mesh's face list
  int32_t represented;  // bits 0-2: vertices, bits 3-5: edges
};

// Children of an inner node are `first` and `first + 1`; a leaf holds triangles first .. first + triangle_count - 1.
struct NodeLink {
  int32_t first;
  int32_t triangle_count;  // 0 for inner nodes
};

// Sphere around all vertices of the node's triangles.
struct NodeSphere {
  float x, y, z, radius;
};

struct MeshOffsets {
  int64_t vertex, face, edge, node;
};

struct MeshSetView {
  const double* vertices;          // (vertices, 3)
  const int32_t* faces;            // (faces, 3)
  const int32_t* edges;            // (edges, 2)
  const Triangle* triangles;       // (faces), leaf order
  const NodeSphere* node_spheres;  // (nodes)
  const NodeLink* node_links;      // (nodes)
  const MeshOffsets* offsets;      // (meshes + 1): the next row ends a mesh's rows
};

// The hierarchy builder keeps every tree within this depth, so a fixed traversal stack cannot overflow.
constexpr int kMaxTreeDepth = 48;

}  // namespace pgccd
