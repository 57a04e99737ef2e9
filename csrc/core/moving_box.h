// A body in a box that moves, for bodies that fill little of their SBV: the box around it at both ends of the step. A
// body without a box is a point that stays within some distance of its SBV centre.
#pragma once

#include "core/vec3.h"

namespace pgccd {

// Lengths are in units of `unit`, the body's SBV radius in float32. Every point of the body is at every time within
// `growth` of the point that moves straight from its place in the box at t0 to that in the box at t1.
struct alignas(16) MovingBox {
  float unit;
  float growth;
  Vec3<float> centre[2];   // relative to the SBV centre
  Vec3<float> half[2][3];  // half of the edges; zero without a box
  float unused[2];         // explicit padding

  // Otherwise the box would not be much smaller than the SBV: bodies that turn so far have none.
  PGCCD_HD bool is_slender() const { return growth < 0.75f; }
};
constexpr int kMovingBoxColumns = 28;
static_assert(sizeof(MovingBox) == kMovingBoxColumns * sizeof(float));

}  // namespace pgccd
