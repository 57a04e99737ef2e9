// Poses of the bodies of a robot, and arcs near which they move.
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
// A configuration as a segment of which it is the begin.
PGCCD_HD ArmSpan still_span(const Arm& arm, const double* q) { return {{q, arm.coordinate_count, 0, 0.0}, 0.0, 0.0}; }

void arm_poses(const Executor& executor, const Arm& arm, const double* q, int64_t count, const ArmPoses& out);
void arm_poses(const DeviceContext& context, const Arm& arm, const double* q, int64_t count, const ArmPoses& out);

// Paths of one segment each; of that the part from `begin` to `end` (paths,), in which bodies turn by at most
// kMostTurn.
struct ArmSpans {
  ArmPaths paths;
  const double *begin, *end;

  PGCCD_HD ArmSpan span(const Arm& arm, int64_t k) const { return {curve_of(paths, arm, k, 0), begin[k], end[k]}; }
};

struct ArmArcs {
  ArmPoses start;
  double* end;       // (paths, bodies, 3) positions
  double* rotation;  // (paths, bodies, 3)
  double* stray;     // (paths, bodies): how far points of bodies are from the arc; of equal ends the error of poses
};

PGCCD_HD void store_arc(const ArmArcs& out, int64_t row, const ArmArc& arc) {
  store_pose(out.start, row, arc.start);
  store_vec3(out.end + 3 * row, arc.end);
  store_vec3(out.rotation + 3 * row, arc.rotation);
  out.stray[row] = arc.stray;
}

void arm_arcs(const Executor& executor, const Arm& arm, const ArmSpans& spans, const ArmArcs& out);
void arm_arcs(const DeviceContext& context, const Arm& arm, const ArmSpans& spans, const ArmArcs& out);

}  // namespace pgccd
