// Poses of the bodies of a robot, and how far they stray from arcs.
#pragma once

#include "kernels/arms/arm.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

struct ArmPoses {
  double* position;     // (configurations, bodies, 3)
  double* orientation;  // (configurations, bodies, 4)
};

// In the world, of configurations (count, coordinates).
void arm_poses(const Executor& executor, const Arm& arm, const double* q, int64_t count, const ArmPoses& out);

// Joints move at constant rates from q0 to q1, (count, coordinates) each; of that the part from `begin` to `end`
// (count,), in which bodies turn by at most kMostTurn.
struct ArmMotions {
  const double *q0, *q1, *begin, *end;
  int64_t count;
};

// (count, bodies): how far bodies stray from the arcs between their poses at both ends; of equal ends, the error of the
// poses.
void arm_strays(const Executor& executor, const Arm& arm, const ArmMotions& motions, double* stray);

}  // namespace pgccd
