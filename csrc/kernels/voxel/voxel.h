// Collision detection by voxels, after Lawlor & Kale, "A voxel-based parallel collision detection algorithm" (ICS
// 2002), with moving triangles: the baseline for comparison. CPU only.
//
// A sparse regular grid of voxels, several times as large as a triangle. The box of every swept triangle is put into
// all voxels that it touches; each voxel finds the pairs of overlapping boxes. A pair in several voxels is accepted by
// the one that contains the point of the largest lower coordinates.
#pragma once

#include <cstdint>
#include <functional>

#include "core/bodies.h"
#include "kernels/executor.h"

namespace pgccd {

// The box of one swept triangle, grown by half of the distance at which a contact may be reported; rounded outward.
struct TriangleBox {
  float lower[3], upper[3];
  int32_t body;      // row of the given bodies
  int32_t triangle;  // row of its mesh's triangles
};
static_assert(sizeof(TriangleBox) == 32);

// Voxel (x, y, z) contains the points with x <= coordinate / size < x + 1, likewise y and z.
struct Voxel {
  int32_t x, y, z;
};

// Bound of the magnitude of voxel coordinates.
constexpr int32_t kVoxelLimit = int32_t{1} << 20;

struct VoxelBodies {
  RigidBodies bodies;
  double voxel_size;
  double separation;
  double tolerance;  // as in pair_tolerance
};

// The voxels touched by boxes, by ascending coordinates, and the number of boxes of each. `make_output(count)` returns
// memory for `count` of both.
struct TouchedVoxels {
  Voxel* voxels;
  int64_t* counts;
};
void voxels_touched(const Executor& executor, const VoxelBodies& input,
                    const std::function<TouchedVoxels(int64_t)>& make_output);

// The boxes of each voxel, grouped in the given order of voxels, unsorted within a voxel. Throws invalid_argument if
// voxels or counts are not those of `voxels_touched`, in any order.
void voxel_boxes(const Executor& executor, const VoxelBodies& input, const Voxel* voxels, const int64_t* counts,
                 int64_t voxel_count, TriangleBox* boxes);

// Boxes [begin, begin + count) of one sender. `first_body` is the number of its first body.
struct BoxSegment {
  int64_t begin, count, first_body;
};

struct VoxelContents {
  const TriangleBox* boxes;
  const BoxSegment* segments;
  const Voxel* voxels;
  const int64_t* first_segment;  // (voxels + 1): a voxel's segments end where the next one's begin
  int64_t voxel_count;
  double voxel_size;
};

struct TrianglePair {
  int64_t body_a, triangle_a, body_b, triangle_b;  // body_a < body_b
};

// Pairs of triangles of two bodies with overlapping boxes, each once over all voxels; unsorted.
void voxel_pairs(const Executor& executor, const VoxelContents& contents,
                 const std::function<TrianglePair*(int64_t)>& make_output);

}  // namespace pgccd
