// Read-only views of the meshes that bodies share. Rows of all meshes are concatenated; indices are local to a mesh.
// The body frame has its origin at the mesh's origin; float32 data are relative to the SBV centre instead, to preserve
// precision however far that is from the origin.
#pragma once

#include <cstdint>

#include "core/vec3.h"

namespace pgccd {

// Elements of a mesh. A segment is a triangle (a, b, b) without area, a point (a, a, a): the same tests are exact for
// them. In a mesh triangles come first, then segments, then points; a leaf has elements of one kind.
enum class ElementKind : int32_t { kTriangle = 0, kSegment = 1, kPoint = 2 };

// One element, in the order of the hierarchy's leaves. Every vertex and every edge of a mesh is *represented* by
// exactly one of its elements (representative triangles, Curtis, Tamstorf & Manocha 2008), so that a feature pair is
// emitted once.
struct Triangle {
  int32_t vertex[3];
  int32_t edge[3];      // edge k joins vertex k and vertex (k + 1) % 3; -1 if they are the same
  int32_t face;         // row in the mesh's face list
  int32_t represented;  // bits 0-2: vertices, bits 3-5: edges; from bit 6 on: the kind

  PGCCD_HD ElementKind kind() const { return static_cast<ElementKind>(represented >> 6); }
};

// The hierarchy is a tree of blocks of up to eight sibling nodes, so that one node is tested against eight at a time.
// Node n is slot n % 8 of block n / 8; the root is node 0, alone in block 0. Blocks of parents precede those of their
// children.
constexpr int kBlockWidth = 8;

// Bounds of all vertices of each node's triangles: a sphere, and a slab low <= normal . (vertex - centre) <= high about
// the same centre. Neighbouring triangles of a surface have a thin slab, which separates two surfaces that face each
// other. Empty slots hold NaN, with which nothing overlaps.
struct NodeBlock {
  float x[kBlockWidth], y[kBlockWidth], z[kBlockWidth], radius[kBlockWidth];
  float normal_x[kBlockWidth], normal_y[kBlockWidth], normal_z[kBlockWidth];  // unit, to within float32 rounding
  float low[kBlockWidth], high[kBlockWidth];
};
constexpr int kBlockColumns = 9;

struct alignas(16) NodeLink {
  int32_t first;           // inner node: the block of its children; leaf: its first triangle
  int32_t triangle_count;  // 0 for inner nodes, -1 for empty slots
  int32_t first_points;    // leaf: its first row of `leaf_points`
  int32_t points_count;    // leaf: its number of these rows
};

// Upper bounds of a node's support function h(d) = max over its vertices of d . (vertex - centre), sampled at
// directions on the faces of the cube [-1, 1]^3, each divided into kSupportCells x kSupportCells cells. Face 2 a is
// where coordinate a is 1, face 2 a + 1 where it is -1. Byte q of rows[face][p], the lowest first, is the sample where
// coordinate a + 1 (mod 3) is p / 1.5 - 1 and coordinate a + 2 is q / 1.5 - 1, in units of kSupportStep times the
// node's radius.
constexpr int kSupportCells = 3, kSupportFaces = 6;
struct alignas(16) NodeSupport {
  int32_t rows[kSupportFaces][kSupportCells + 1];
};
constexpr int kSupportWords = kSupportFaces * (kSupportCells + 1);
// 255 of them are more than the square root of 3, the length of the longest of these directions.
constexpr float kSupportStep = 7.0f / 1024.0f;

// Eight vertices of a leaf's triangles; a leaf lists each of its vertices once. The last one fills unused slots.
struct alignas(16) LeafPoints {
  float x[kBlockWidth], y[kBlockWidth], z[kBlockWidth];
  int32_t vertex[kBlockWidth];
};

struct MeshOffsets {
  int64_t vertex, face, edge, block, leaf_points, corners;
};

// Corners of the triangles and segments in float32, as nine columns (corner 0 x, y, z, corner 1 x, ...) of `stride`
// values, so that eight neighbouring elements load as lanes; the columns are padded at their end for that. Points have
// none: they would be three copies. Without points, rows are those of `triangles`.
struct CornerColumns {
  const float* first;
  int64_t stride;
  bool leaves_out_points;
};

// Which meshes are solids, and one vertex of each connected piece of triangles and segments of every mesh. All null if
// none is a solid.
struct SolidColumns {
  const uint8_t* is_solid;     // (meshes,)
  const int64_t* piece_begin;  // (meshes + 1,) first rows of the meshes' pieces
  const int32_t* vertex;       // (pieces,)
};

struct MeshSetView {
  const double* vertices;            // (vertices, 3), body frame
  const int32_t* faces;              // (faces, 3)
  const int32_t* edges;              // (edges, 2)
  const Triangle* triangles;         // (faces), leaf order
  const NodeBlock* node_blocks;      // (blocks)
  const NodeLink* node_links;        // (blocks, 8)
  const NodeSupport* node_supports;  // (blocks, 8)
  const LeafPoints* leaf_points;
  CornerColumns corners;       // (9, stride), rows of a mesh in the order of its `triangles`
  const MeshOffsets* offsets;  // (meshes + 1): the next row is the end of a mesh's rows
  int64_t mesh_count;
  int64_t feature_count;  // of vertices, faces or edges, whichever are most, of all meshes
  // Both null if the SBV centre of every mesh is its origin.
  const double* centres;  // (meshes, 3) SBV centres, body frame
  const double* reaches;  // (meshes,) bound of the vertices' distance from the origin; the radius if centred
  // Null if every mesh fills much of its SBV.
  const double* boxes;  // (meshes, 4, 3) centre of a box and half of its edges, relative to the SBV centre; 0: none
  SolidColumns solids;
};

// Points are the last elements of a mesh.
PGCCD_HD bool has_points(const MeshSetView& meshes, int64_t mesh) {
  return meshes.triangles[meshes.offsets[mesh + 1].face - 1].kind() == ElementKind::kPoint;
}

PGCCD_HD bool is_solid(const MeshSetView& meshes, int64_t mesh) {
  return meshes.solids.is_solid != nullptr && meshes.solids.is_solid[mesh] != 0;
}

// Maximum number of triangles per leaf: the number of lanes.
constexpr int kMaxLeafTriangles = 8;

// The hierarchy builder limits every path from the root to this many nodes, so a fixed traversal stack cannot overflow.
constexpr int kMaxTreeDepth = 48;

}  // namespace pgccd
