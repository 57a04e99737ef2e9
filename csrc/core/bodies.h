// Motion of bodies during one step. Two models with one interface: a body's reference point (the origin of a rigid
// body, the SBV centre of a deforming one) moves on the straight line from position_t0 to position_t1; a point's offset
// from it rotates at a constant rate (rigid arcs) or is the interpolation of two end offsets (linear paths).
#pragma once

#include <cstdint>

#include "core/mesh_set.h"
#include "core/rotation.h"
#include "core/rounding.h"

namespace pgccd {

struct BodyCentres {
  const double* position_t0;       // (bodies, 3), world
  const double* position_t1;       // (bodies, 3), world
  const double* radius;            // (bodies,) SBV radius
  int64_t count;                   // bodies
  const double* margin = nullptr;  // (bodies,) thickness, or null for none
};

struct RigidBodies {
  MeshSetView meshes;
  const int32_t* mesh_index;  // (bodies,)
  BodyCentres centres;
  const double* orientation;  // (bodies, 4) unit quaternions at t0
  const double* rotation;     // (bodies, 3) rotation vector of the step, world frame, radians
  bool linear_path;           // vertices move on straight lines instead of arcs
};

// A vertex relative to its body's centre, at both ends of the step; rounded, for culling.
struct alignas(16) LocalVertex {
  float at[2][4];  // x, y, z and 0, at t0 and at t1

  PGCCD_HD Vec3<float> position(int end) const {
#if defined(__CUDA_ARCH__)
    const float4 all = *reinterpret_cast<const float4*>(at[end]);  // in one load
    return {all.x, all.y, all.z};
#else
    return {at[end][0], at[end][1], at[end][2]};
#endif
  }
};

// Every body has its own vertices and node volumes: rows of body b start at vertex_begin[b] and block_begin[b].
struct DeformingBodies {
  MeshSetView meshes;  // topology; `vertices` and `node_blocks` are not read
  const int32_t* mesh_index;
  BodyCentres centres;
  int64_t vertex_count;               // of all bodies
  const double* vertices_t0;          // (all vertices, 3), world
  const double* vertices_t1;          // (all vertices, 3), world
  const NodeBlock* blocks_t0;         // (all blocks) relative to the body's centre at t0
  const NodeBlock* blocks_t1;         // (all blocks) relative to the body's centre at t1, same radii
  const int64_t* vertex_begin;        // (bodies,)
  const int64_t* block_begin;         // (bodies,)
  int64_t block_count;                // of all bodies
  const LocalVertex* local_vertices;  // (all vertices)
};

// True if the body exists and its mesh and rows are in range. The mesh set itself is not checked.
PGCCD_HD bool is_within(int64_t row, int64_t count) { return row >= 0 && row < count; }
template <class Bodies>
PGCCD_HD bool names_mesh(const Bodies& bodies, int64_t body) {
  return is_within(body, bodies.centres.count) && is_within(bodies.mesh_index[body], bodies.meshes.mesh_count);
}
PGCCD_HD bool is_sound(const RigidBodies& bodies, int64_t body) { return names_mesh(bodies, body); }
// True if rows [begin, begin + size) are within `count`.
PGCCD_HD bool are_within(int64_t begin, int64_t size, int64_t count) { return begin >= 0 && begin <= count - size; }
PGCCD_HD bool is_sound(const DeformingBodies& bodies, int64_t body) {
  if (!names_mesh(bodies, body)) return false;
  const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body];
  return are_within(bodies.vertex_begin[body], rows[1].vertex - rows[0].vertex, bodies.vertex_count) &&
         are_within(bodies.block_begin[body], rows[1].block - rows[0].block, bodies.block_count);
}

// The SBV radius; of points at one place, such as a sphere, the margin.
constexpr double kRadiusOfPoint = 1e-30;
PGCCD_HD double size_of(const BodyCentres& centres, int64_t body) {
  const double radius = centres.radius[body];
  const bool is_point = radius >= 0.0 && radius <= kRadiusOfPoint && centres.margin != nullptr;
  return is_point ? larger(radius, centres.margin[body]) : radius;
}

// A negative tolerance is relative to the smaller size of the pair.
PGCCD_HD double pair_tolerance(const BodyCentres& centres, int64_t i, int64_t j, double tolerance) {
  return tolerance < 0.0 ? -tolerance * smaller(size_of(centres, i), size_of(centres, j)) : tolerance;
}

// The separation of a pair including margins, rounded up so that no contact is missed. For a body and itself, twice its
// margin.
PGCCD_HD double pair_separation(const BodyCentres& centres, int64_t i, int64_t j, double separation) {
  if (centres.margin == nullptr) return separation;
  return add_up(separation, add_up(centres.margin[i], centres.margin[j]));
}

// Offset of body j's reference point from body i's: one rounding per coordinate, however far the pair is from the
// world's origin.
template <class T>
struct RelativeCentreIn {
  Vec3<T> at_t0;
  Vec3<T> at_t1;
};
using RelativeCentre = RelativeCentreIn<double>;

// In double-double, exact.
template <class T = double>
PGCCD_HD RelativeCentreIn<T> relative_centre(const BodyCentres& centres, int64_t i, int64_t j) {
  const auto position = [](const double* rows, int64_t body) { return cast<T>(load_vec3(rows + 3 * body)); };
  return {position(centres.position_t0, j) - position(centres.position_t0, i),
          position(centres.position_t1, j) - position(centres.position_t1, i)};
}

}  // namespace pgccd
