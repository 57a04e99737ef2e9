// How far a robot goes that was to collide.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

struct SlowDownInput {
  const int64_t* rows;  // (count,) robots looked at; any may be named several times
  int64_t count;
  const double* first;     // first toi of each robot in what it was to make of the step; infinite: none
  const double* fraction;  // what each robot was to make of the step
  double approach;         // part of the way to the toi that it goes
  double smallest;         // who could make less of the step stays
};

// Robots that do not move at all can only touch where they did before: nothing is left to decide about them.
PGCCD_HD void slow_down(const SlowDownInput& input, int64_t k, double* fraction, uint8_t* changes) {
  const double first = input.first[input.rows[k]], former = input.fraction[input.rows[k]];
  const bool slower = first <= 1.0 && former > 0.0;
  const double allowed = former * first * input.approach;
  changes[k] = slower ? 1 : 0;
  fraction[k] = slower ? (allowed < input.smallest ? 0.0 : allowed) : former;
}

}  // namespace pgccd
