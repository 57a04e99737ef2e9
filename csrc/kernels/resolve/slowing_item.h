// The fraction of its path that a colliding body moves.
#pragma once

#include <cstdint>
#include <limits>

#include "core/platform.h"

namespace pgccd {

constexpr double kNever = std::numeric_limits<double>::infinity();

struct SlowedDown {
  double fraction;
  bool changes;
};

// Bodies that do not move can only touch where they did before, so they do not change.
PGCCD_HD SlowedDown slowed_down(double first, double former, double approach, double smallest) {
  if (!(first <= 1.0 && former > 0.0)) return {former, false};
  const double allowed = former * first * approach;
  return {allowed < smallest ? 0.0 : allowed, true};
}

// Slows down all bodies in place.
struct SlowAllDown {
  double* first;     // (count,) first toi relative to the part that each body was to move, inf for none; reset to inf
  double* fraction;  // (count,) part of its path that each body moves
  uint8_t* changed;  // (count,)
  int64_t count;
  double approach;  // fraction of the toi by which a body moves
  double smallest;  // a body with a smaller fraction does not move at all

  // Returns whether the body changes.
  PGCCD_HD bool slow_down(int64_t row) const {
    const double toi = first[row];
    const bool looks = toi <= 1.0;
    const SlowedDown made = looks ? slowed_down(toi, fraction[row], approach, smallest) : SlowedDown{};
    changed[row] = made.changes ? 1 : 0;
    if (made.changes) fraction[row] = made.fraction;
    if (looks) first[row] = kNever;
    return made.changes;
  }
};

// Contacts (count,) of bodies; padding has negative rows.
struct FirstToiInput {
  const int64_t* pairs;  // (count, 2) rows of bodies; either may be negative: the body is none of these
  const double* toi;     // (count,) >= 0
  int64_t count;
  int64_t body_count;

  // True if one side of a pair (of 2 count) is none of the bodies, or one that exists.
  PGCCD_HD bool is_sound(int64_t side) const { return pairs[side] < body_count; }
};

}  // namespace pgccd
