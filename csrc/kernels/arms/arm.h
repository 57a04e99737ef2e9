// Robots as the kernels read them: a tree of joints, the bodies on its frames, obstacles, and the pairs to test.
#pragma once

#include <cstdint>

#include "core/bodies.h"

namespace pgccd {

enum class JointKind : int32_t { kFixed = 0, kRevolute = 1, kPrismatic = 2 };

// A joint and the frame that it moves. Frames have the number of their joint.
struct Joint {
  int32_t parent;      // the frame that it is attached to, one before it; -1 for the base
  int32_t kind;        // JointKind
  int32_t coordinate;  // the entry of a configuration that it follows; -1 if it is fixed

  PGCCD_HD bool turns() const { return kind == static_cast<int32_t>(JointKind::kRevolute); }
  PGCCD_HD bool slides() const { return kind == static_cast<int32_t>(JointKind::kPrismatic); }
  PGCCD_HD bool moves() const { return coordinate >= 0; }
};
constexpr int64_t kJointColumns = 3;

struct JointPlace {
  double position[3], orientation[4];  // of the frame in its parent, at value 0
  double axis[3];                      // unit, in the joint's frame
  double scale, offset;                // value = scale configuration[coordinate] + offset: radians or length
  double distance;                     // of the frame from its parent at value 0, rounded up
};
constexpr int64_t kPlaceColumns = 13;
static_assert(sizeof(JointPlace) == kPlaceColumns * sizeof(double));

struct Arm {
  int64_t joint_count;       // frames
  const Joint* joints;       // parents come first
  const JointPlace* places;  // (joints,)
  // (joints, joints): in any configuration, a bound of the sine of the angle between the axes of two revolute joints
  // of which one carries the other.
  const double* crossing;
  int64_t coordinate_count;
  int64_t body_count;
  const int32_t* chain_begin;  // (bodies + 1,) first rows of the bodies' chains
  const int32_t* chain;        // frames from the base to that of a body
  const double* body_reach;    // (bodies,) bound of the distance of a body's points from the origin of its frame
  double room;                 // all prismatic joints together slide by less: see `Robot._room` in Python
};

// Two bodies, the first of which belongs to the robot. Both are placed in the last frame that carries both, the last of
// `shared` frames that their chains begin with; or in the world, if these are none.
struct ArmPair {
  int32_t first, second, shared;
};
constexpr int64_t kArmPairColumns = 3;

// Obstacles are bodies after those of the robot. They rest, in one pose or in one of each path; or they move on arcs,
// one of each segment of the paths.
struct ArmObstacles {
  int64_t count;
  int64_t row_count;          // of each column below
  const double* position_t0;  // (rows, obstacles, 3)
  const double* position_t1;
  const double* orientation;  // (rows, obstacles, 4)
  const double* rotation;     // (rows, obstacles, 3)
  const double* error;        // (obstacles,) of poses between waypoints
  bool move;                  // a row is a segment; else it is a path, or the only one

  PGCCD_HD int64_t row(int64_t path, int64_t segment) const { return move ? segment : (row_count == 1 ? 0 : path); }
};

struct ArmScene {
  Arm arm;
  ArmObstacles obstacles;
  MeshSetView meshes;
  const int32_t* mesh_index;  // (bodies and obstacles,)
  const double* radius;       // of their SBV
  const double* margin;       // their thickness
  const ArmPair* pairs;       // in the order of (first, second)
  int64_t pair_count;
};

// Paths of configurations, by control points (paths, control, coordinates): those of a segment of degree d are d + 1
// rows, the last of which is the first one of the next segment. Degree 1: control points are waypoints.
struct ArmPaths {
  const double* control;
  int64_t path_count, control_count;
  int32_t degree = 1;
  double error = 0.0;  // of control points

  PGCCD_HD int64_t segment_count() const { return (control_count - 1) / degree; }
};

}  // namespace pgccd
