// Parameters of the nanorobot world.
#pragma once

#include <cstdint>

#include "core/vec3.h"

namespace pgccd {

enum class MovementPattern : int64_t {
  kRandom = 0,  // straight courses in uniformly random directions
  kSkewed = 1,  // to one of the eight corners, a stay there, then to another corner
};

// The parameters as the operators take them; pgccd/sim/model.py has the same fields.
struct WorldIntegers {
  int64_t robot_count;
  int64_t cells_x, cells_y, cells_z;
  int64_t pattern;
  int64_t seed;
  int64_t stay_shortest, stay_longest;
};

struct WorldScales {
  double radius, spacing, speed, spin;
  double course_change, resumption;
  double arrival, crowd;
};

struct World {
  int64_t robot_count;  // of the whole world; ids are 0 .. robot_count - 1
  int64_t cells[3];     // of the start lattice
  MovementPattern pattern;
  uint64_t seed;
  int64_t stay_shortest, stay_longest;  // steps
  double radius;                        // largest SBV radius
  double spacing;                       // of the start lattice, in radii, > 2
  double speed;                         // mean displacement per step, in radii
  double spin;                          // largest rotation per step, radians
  double course_change;                 // probability of a new course, per step
  double resumption;                    // probability that a robot turns to its corner (again), per step
  double arrival;                       // arrival at a corner: distance relative to the smallest box edge
  double crowd;                         // a robot reversed within this distance of its corner stays too

  // The box is centred on the origin.
  PGCCD_HD Vec3<double> half_extent() const {
    const double half_cell = 0.5 * (spacing * radius);
    return {static_cast<double>(cells[0]) * half_cell, static_cast<double>(cells[1]) * half_cell,
            static_cast<double>(cells[2]) * half_cell};
  }
};

constexpr int64_t kNoTarget = -1;
constexpr int64_t kNotStaying = -1;

}  // namespace pgccd
