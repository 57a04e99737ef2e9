// The slowed motion of the two robots of each affected pair.
#pragma once

#include "kernels/simulate/resolution_item.h"
#include "kernels/simulate/robot.h"

namespace pgccd {

// Columns that define a robot's motion.
struct MovingRobots {
  const int64_t* id;
  const double* position;          // (count, 3)
  const double* orientation;       // (count, 4)
  const double* velocity;          // (count, 3)
  const double* angular_velocity;  // (count, 3)
  int64_t count;
};

// Rows 2 k and 2 k + 1 are the robots of the k-th pair found.
struct PairMotion {
  int32_t* mesh_index;
  double* position_t0;
  double* radius;
  double* orientation;
  double* position_t1;
  double* rotation;
};

struct AffectedMotion {
  AffectedPairs affected;
  int64_t pair_count;
  MovingRobots own, ghosts;   // rows of ghosts follow those of own robots
  const double* fraction;     // (own + ghosts)
  const double* mesh_radius;  // (mesh_count,)
  int64_t mesh_count;         // the robot with id k has mesh k modulo this number

  int64_t capacity;
  int64_t* pairs;  // (capacity, 2) pairs found; unused rows are not written, here and in the motion
  PairMotion motion;
  int64_t* counts;  // (kPairCounts)

  // Writes one robot of a found pair to row `at`, unless that exceeds the capacity.
  PGCCD_HD void store(int64_t pair, int side, int64_t at) const {
    if (at >= capacity) return;
    const int64_t row = 2 * at + side, held = affected.pairs[2 * pair + side];
    pairs[row] = held;
    const bool is_ghost = held >= own.count;
    const MovingRobots& robots = is_ghost ? ghosts : own;
    const int64_t robot = is_ghost ? held - own.count : held;
    const Vec3<double> start = load_vec3(robots.position + 3 * robot);
    const Quaternion orientation = load_quaternion(robots.orientation + 4 * robot);
    const auto kind = static_cast<int64_t>(static_cast<uint64_t>(robots.id[robot]) % static_cast<uint64_t>(mesh_count));
    motion.mesh_index[row] = static_cast<int32_t>(kind);
    motion.radius[row] = mesh_radius[kind];
    robot_detail::store_row(motion.position_t0 + 3 * row, start);
    motion.orientation[4 * row] = orientation.w;
    robot_detail::store_row(motion.orientation + 4 * row + 1, orientation.v);
    const double made = fraction[held];
    robot_detail::store_row(motion.position_t1 + 3 * row, start + made * load_vec3(robots.velocity + 3 * robot));
    robot_detail::store_row(motion.rotation + 3 * row, made * load_vec3(robots.angular_velocity + 3 * robot));
  }
};

}  // namespace pgccd
