// Poses of the bodies of a robot, and how far they stray from arcs.
#pragma once

#include "kernels/arms/kinematics_item.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

struct ArmPoses {
  double* position;     // (configurations, bodies, 3)
  double* orientation;  // (configurations, bodies, 4)
};

PGCCD_HD void store_pose(const ArmPoses& out, int64_t row, const RigidPose& pose) {
  store_vec3(out.position + 3 * row, pose.position);
  out.orientation[4 * row] = pose.orientation.w;
  store_vec3(out.orientation + 4 * row + 1, pose.orientation.v);
}

// In the world, of configurations (count, coordinates).
void arm_poses(const Executor& executor, const Arm& arm, const double* q, int64_t count, const ArmPoses& out);
void arm_poses(const DeviceContext& context, const Arm& arm, const double* q, int64_t count, const ArmPoses& out);

// Joints move at constant rates from q0 to q1, (count, coordinates) each; of that the part from `begin` to `end`
// (count,), in which bodies turn by at most kMostTurn.
struct ArmMotions {
  const double *q0, *q1, *begin, *end;
  int64_t count;

  PGCCD_HD ArmSpan span(int64_t k, int64_t coordinates) const {
    return {q0 + k * coordinates, q1 + k * coordinates, begin[k], end[k]};
  }
};

// (count, bodies): how far bodies stray from the arcs between their poses at both ends; of equal ends, the error of the
// poses.
void arm_strays(const Executor& executor, const Arm& arm, const ArmMotions& motions, double* stray);
void arm_strays(const DeviceContext& context, const Arm& arm, const ArmMotions& motions, double* stray);

}  // namespace pgccd
