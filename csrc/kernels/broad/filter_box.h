// Bounds that broad phases test before the predicate: 32 bytes per body in float32, rounded outward, relative to an
// origin in the scene.
#pragma once

#include <limits>

#include "core/lanes.h"
#include "kernels/broad/body_volumes.h"

namespace pgccd {

struct alignas(32) FilterBox {
  float lower[3];
  float radius;  // of the sphere around the middle of the box that contains the CBV
  float minus_upper[3];
  int32_t body;
};

PGCCD_HD FilterBox filter_box(const BroadBodies& bodies, Vec3<double> origin, int64_t body) {
  if (bodies.is_absent(body)) {  // a box that overlaps nothing
    constexpr float kNowhere = std::numeric_limits<float>::infinity();
    return {{kNowhere, kNowhere, kNowhere}, 0.0f, {kNowhere, kNowhere, kNowhere}, static_cast<int32_t>(body)};
  }
  const Vec3<double> travel =
      load_vec3(bodies.centres.position_t1 + 3 * body) - load_vec3(bodies.centres.position_t0 + 3 * body);
  const SweptBox box = swept_box(bodies, body);
  const Vec3<double> lower = box.lower - origin, upper = box.upper - origin;
  const double radius = (swept_reach(bodies, body, travel) + 0.5 * norm(travel)) * (1.0 + 0x1p-20);
  // `balls_meet` computes the middle of the rounded box, with an error of up to 2^-21 of the largest coordinate per
  // axis, and the difference of two middles; 2^-19 is twice the total. The middle of the box itself has the rounding
  // error of world coordinates, which may be far larger; for large bodies 2^-20 covers it.
  const double rounding =
      0x1p-19 * larger(max_abs(lower), max_abs(upper)) + kBoxRounding * larger(max_abs(box.lower), max_abs(box.upper));
  return {{float_below(lower.x), float_below(lower.y), float_below(lower.z)},
          float_above(radius + rounding),
          {-float_above(upper.x), -float_above(upper.y), -float_above(upper.z)},
          static_cast<int32_t>(body)};
}

// Also for nodes, which begin with the same members.
template <class Box>
PGCCD_HD bool boxes_overlap(const FilterBox& a, const Box& b) {
  bool overlap = true;
  for (int k = 0; k < 3; ++k) overlap &= a.lower[k] <= -b.minus_upper[k] && b.lower[k] <= -a.minus_upper[k];
  return overlap;
}

// False only if the CBVs certainly stay apart. NaN (from boxes beyond the range of floats) and underflow count as
// overlap.
PGCCD_HD bool balls_meet(const FilterBox& a, const FilterBox& b) {
  float distance_squared = 0.0f;
  for (int k = 0; k < 3; ++k) {
    const float difference = 0.5f * (a.lower[k] - a.minus_upper[k]) - 0.5f * (b.lower[k] - b.minus_upper[k]);
    distance_squared += difference * difference;
  }
  const float reach = a.radius + b.radius;
  return !(distance_squared > reach * reach + FLT_MIN);
}

#if !defined(__CUDACC__)

// One box against many, with one comparison each.
class BoxOverlap {
 public:
  explicit BoxOverlap(const FilterBox& self)
      : limit_{-self.minus_upper[0], -self.minus_upper[1], -self.minus_upper[2], 0.0f,
               -self.lower[0],       -self.lower[1],       -self.lower[2],       0.0f} {}

  template <class Box>
  bool with(const Box& other) const {
    const uint32_t bits = lane_bits(load<Float8>(other.lower) <= limit_);
    return (bits & kBounds) == kBounds;
  }

 private:
  static constexpr uint32_t kBounds = 0b01110111;
  Float8 limit_;
};

#endif

}  // namespace pgccd
