// One robot of the nanorobot simulation, and robots as columns.
#pragma once

#include <cstdint>

#include "core/rotation.h"

namespace pgccd {

struct Robot {
  Vec3<double> position;
  Quaternion orientation;
  Vec3<double> velocity;
  Vec3<double> angular_velocity;
  int64_t target;
  int64_t stay_until;
};

// Robots as columns; any subset in any order.
struct RobotColumns {
  const int64_t* id;
  const double* position;          // (count, 3)
  const double* orientation;       // (count, 4)
  const double* velocity;          // (count, 3), length per step
  const double* angular_velocity;  // (count, 3), radians per step, world frame
  const int64_t* target;           // corner 0 .. 7 (bit k: upper end of axis k), or kNoTarget
  const int64_t* stay_until;       // first step of the next course, or kNotStaying
  int64_t count;
};

// Memory for results; null for columns that an operation does not change.
struct RobotResults {
  double* position = nullptr;
  double* orientation = nullptr;
  double* velocity = nullptr;
  double* angular_velocity = nullptr;
  int64_t* target = nullptr;
  int64_t* stay_until = nullptr;
};

namespace robot_detail {

PGCCD_HD void store_row(double* row, Vec3<double> v) {
  row[0] = v.x;
  row[1] = v.y;
  row[2] = v.z;
}

}  // namespace robot_detail

PGCCD_HD Robot load_robot(const RobotColumns& robots, int64_t row) {
  return {load_vec3(robots.position + 3 * row),
          load_quaternion(robots.orientation + 4 * row),
          load_vec3(robots.velocity + 3 * row),
          load_vec3(robots.angular_velocity + 3 * row),
          robots.target[row],
          robots.stay_until[row]};
}

PGCCD_HD void store_robot(const RobotResults& results, int64_t row, const Robot& robot) {
  if (results.position) robot_detail::store_row(results.position + 3 * row, robot.position);
  if (results.orientation) {
    results.orientation[4 * row] = robot.orientation.w;
    robot_detail::store_row(results.orientation + 4 * row + 1, robot.orientation.v);
  }
  if (results.velocity) robot_detail::store_row(results.velocity + 3 * row, robot.velocity);
  if (results.angular_velocity) robot_detail::store_row(results.angular_velocity + 3 * row, robot.angular_velocity);
  if (results.target) results.target[row] = robot.target;
  if (results.stay_until) results.stay_until[row] = robot.stay_until;
}

}  // namespace pgccd
