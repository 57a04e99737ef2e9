// The slowed-down motion of the two robots of a pair, wherever the columns of each are.
#pragma once

#include "kernels/simulate/robot.h"

namespace pgccd {

// What moves a robot, as columns.
struct MovingRobots {
  const int64_t* id;
  const double* position;          // (count, 3)
  const double* orientation;       // (count, 4)
  const double* velocity;          // (count, 3)
  const double* angular_velocity;  // (count, 3)
  int64_t count;
};

struct PairMotionInput {
  MovingRobots own, ghosts;  // rows of ghosts follow those of own robots
  const double* fraction;    // (own + ghosts)
  const int64_t* pairs;      // (pair_count, 2)
  int64_t pair_count;
};

// Rows 2 k and 2 k + 1 are the robots of pair k.
struct PairMotion {
  int64_t* id;
  double* position_t0;
  double* orientation;
  double* position_t1;
  double* rotation;
};

PGCCD_HD void store_pair_motion(const PairMotionInput& input, int64_t row, const PairMotion& motion) {
  const int64_t held = input.pairs[row];
  const bool is_ghost = held >= input.own.count;
  const MovingRobots& robots = is_ghost ? input.ghosts : input.own;
  const int64_t at = is_ghost ? held - input.own.count : held;
  const double fraction = input.fraction[held];
  const Vec3<double> start = load_vec3(robots.position + 3 * at);
  const Quaternion orientation = load_quaternion(robots.orientation + 4 * at);
  motion.id[row] = robots.id[at];
  robot_detail::store_row(motion.position_t0 + 3 * row, start);
  motion.orientation[4 * row] = orientation.w;
  robot_detail::store_row(motion.orientation + 4 * row + 1, orientation.v);
  robot_detail::store_row(motion.position_t1 + 3 * row, start + fraction * load_vec3(robots.velocity + 3 * at));
  robot_detail::store_row(motion.rotation + 3 * row, fraction * load_vec3(robots.angular_velocity + 3 * at));
}

}  // namespace pgccd
