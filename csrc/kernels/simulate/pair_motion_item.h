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
  const int64_t* pairs;      // (pair_count, 2); negative: padding
  int64_t pair_count;
  const double* mesh_radius;  // (mesh_count,)
  int64_t mesh_count;         // the robot with id k is of kind k modulo their number
};

// Rows 2 k and 2 k + 1 are the robots of pair k; those of padding rest at the origin.
struct PairMotion {
  int32_t* mesh_index;
  double* position_t0;
  double* radius;
  double* orientation;
  double* position_t1;
  double* rotation;
};

PGCCD_HD void store_rest(int64_t row, const PairMotion& motion) {
  motion.mesh_index[row] = 0;
  motion.radius[row] = 0.0;
  for (double* const vector : {motion.position_t0, motion.position_t1, motion.rotation}) {
    robot_detail::store_row(vector + 3 * row, {0.0, 0.0, 0.0});
  }
  motion.orientation[4 * row] = 1.0;
  robot_detail::store_row(motion.orientation + 4 * row + 1, {0.0, 0.0, 0.0});
}

PGCCD_HD void store_pair_motion(const PairMotionInput& input, int64_t row, const PairMotion& motion) {
  const int64_t held = input.pairs[row];
  if (held < 0) return store_rest(row, motion);
  const bool is_ghost = held >= input.own.count;
  const MovingRobots& robots = is_ghost ? input.ghosts : input.own;
  const int64_t at = is_ghost ? held - input.own.count : held;
  const double fraction = input.fraction[held];
  const Vec3<double> start = load_vec3(robots.position + 3 * at);
  const Quaternion orientation = load_quaternion(robots.orientation + 4 * at);
  const int64_t kind = robots.id[at] % input.mesh_count;
  motion.mesh_index[row] = static_cast<int32_t>(kind);
  motion.radius[row] = input.mesh_radius[kind];
  robot_detail::store_row(motion.position_t0 + 3 * row, start);
  motion.orientation[4 * row] = orientation.w;
  robot_detail::store_row(motion.orientation + 4 * row + 1, orientation.v);
  robot_detail::store_row(motion.position_t1 + 3 * row, start + fraction * load_vec3(robots.velocity + 3 * at));
  robot_detail::store_row(motion.rotation + 3 * row, fraction * load_vec3(robots.angular_velocity + 3 * at));
}

}  // namespace pgccd
