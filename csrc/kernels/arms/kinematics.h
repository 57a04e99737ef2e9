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

// (count, bodies): how far bodies stray from the arcs between their poses while joints move at constant rates from q0
// to q1, (count, coordinates) each; bodies turn by at most kMostTurn.
void arm_strays(const Executor& executor, const Arm& arm, const double* q0, const double* q1, int64_t count,
                double* stray);

}  // namespace pgccd
