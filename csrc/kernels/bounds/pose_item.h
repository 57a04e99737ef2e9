// Pose of a rigid body on its arc at a given time, by the same arithmetic as the narrow phase.
#pragma once

#include <cmath>

#include "core/paths.h"
#include "core/rotation.h"
#include "kernels/bounds/validation.h"

namespace pgccd {

struct RigidPoses {
  const double* position_t0;  // (count, 3)
  const double* position_t1;  // (count, 3)
  const double* orientation;  // (count, 4) at t0
  const double* rotation;     // (count, 3)
  const double* time;         // (count,) in [0, 1]
};

// The rotation vector between orientations (count, 4); NaN if the second one is no unit quaternion.
PGCCD_HD Vec3<double> rotation_between(const double* orientation_t0, const double* orientation_t1, int64_t row) {
  const RowColumn ends{orientation_t1, row + 1, 4, RowCheck::kUnitLength, kUnitTolerance};
  if (is_invalid(ends, row)) return {NAN, NAN, NAN};
  return rotation_between(load_quaternion(orientation_t0 + 4 * row), load_quaternion(orientation_t1 + 4 * row));
}

PGCCD_HD void pose_at(const RigidPoses& poses, int64_t row, double* position, double* orientation) {
  const double t = poses.time[row];
  store_vec3(position + 3 * row,
             (1.0 - t) * load_vec3(poses.position_t0 + 3 * row) + t * load_vec3(poses.position_t1 + 3 * row));
  const Quaternion now =
      orientation_at(load_quaternion(poses.orientation + 4 * row), load_vec3(poses.rotation + 3 * row), t);
  orientation[4 * row] = now.w;
  store_vec3(orientation + 4 * row + 1, now.v);
}

// The first part of a body's arc: where it ends, and its rotation.
struct ShortenedArcs {
  const double* position_t0;  // (count, 3), here and below
  const double* position_t1;
  const double* rotation;
  const double* fraction;  // (count,) in [0, 1]
  double* end;
  double* turn;

  PGCCD_HD void shorten(int64_t body) const {
    for (int64_t k = 3 * body; k < 3 * body + 3; ++k) {
      end[k] = point_on_path(fraction[body], position_t0[k], position_t1[k]);
      turn[k] = point_on_path(fraction[body], 0.0, rotation[k]);
    }
  }
};

}  // namespace pgccd
