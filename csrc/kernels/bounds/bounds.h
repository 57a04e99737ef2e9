// Bounds: motion in the form that later stages read.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "core/moving_box.h"
#include "kernels/bounds/pose_item.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

// Rotation vectors between two orientations, (count, 4) each -> (count, 3), world frame, the shorter way; NaN where the
// second orientation is no unit quaternion, since motions keep the rotation alone.
void rotations_between(const Executor& executor, const double* orientation_t0, const double* orientation_t1,
                       int64_t count, double* rotation);
void rotations_between(const DeviceContext& context, const double* orientation_t0, const double* orientation_t1,
                       int64_t count, double* rotation);

// Positions (count, 3) and unit quaternions (count, 4) of bodies, each at its own time.
void poses_at(const Executor& executor, const RigidPoses& poses, int64_t count, double* position, double* orientation);
void poses_at(const DeviceContext& context, const RigidPoses& poses, int64_t count, double* position,
              double* orientation);

void shorten_arcs(const Executor& executor, const ShortenedArcs& arcs, int64_t count);
void shorten_arcs(const DeviceContext& context, const ShortenedArcs& arcs, int64_t count);

// SBV centres at both ends (bodies, 3), and the radius (bodies,) of the sphere moving straight between them that
// contains the body throughout.
struct MovingSpheres {
  double* centre_t0;
  double* centre_t1;
  double* reach;
};

void moving_spheres(const Executor& executor, const RigidBodies& bodies, int64_t count, const MovingSpheres& out);
void moving_spheres(const DeviceContext& context, const RigidBodies& bodies, int64_t count, const MovingSpheres& out);

// The boxes (bodies,) of bodies of which some meshes fill little of their SBV.
template <class Bodies>
void moving_boxes(const Executor& executor, const Bodies& bodies, MovingBox* boxes);
template <class Bodies>
void moving_boxes(const DeviceContext& context, const Bodies& bodies, MovingBox* boxes);

struct DeformingInput {
  MeshSetView meshes;
  const int32_t* mesh_index;  // (bodies,)
  int64_t body_count;
  int64_t vertex_count;  // of all bodies
  const double* vertices_t0;
  const double* vertices_t1;
  const int64_t* vertex_begin;  // (bodies,)
  int64_t block_count;          // of all bodies
  const int64_t* block_begin;   // (bodies,)
};

// True if the body's mesh exists and its rows of vertices and node blocks are in range.
PGCCD_HD bool is_sound(const DeformingInput& input, int64_t body) {
  const int32_t mesh = input.mesh_index[body];
  if (!is_within(mesh, input.meshes.mesh_count)) return false;
  const MeshOffsets* rows = input.meshes.offsets + mesh;
  return are_within(input.vertex_begin[body], rows[1].vertex - rows[0].vertex, input.vertex_count) &&
         are_within(input.block_begin[body], rows[1].block - rows[0].block, input.block_count);
}

// The members of DeformingBodies that depend on vertex positions.
struct DeformingBounds {
  double* position_t0;  // (bodies, 3)
  double* position_t1;  // (bodies, 3)
  double* radius;       // (bodies,)
  NodeBlock* blocks_t0;
  NodeBlock* blocks_t1;
  LocalVertex* local_vertices;
};

void refit(const Executor& executor, const DeformingInput& input, const DeformingBounds& bounds);
void refit(const DeviceContext& context, const DeformingInput& input, const DeformingBounds& bounds);

}  // namespace pgccd
