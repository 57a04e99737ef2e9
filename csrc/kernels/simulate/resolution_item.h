// The fraction of the step that a colliding robot moves.
#pragma once

#include <cstdint>
#include <limits>

#include "core/platform.h"
#include "kernels/padded_pairs.h"

namespace pgccd {

constexpr double kNever = std::numeric_limits<double>::infinity();

struct SlowedDown {
  double fraction;
  bool changes;
};

// Robots that do not move can only touch where they did before, so they do not change.
PGCCD_HD SlowedDown slowed_down(double first, double former, double approach, double smallest) {
  if (!(first <= 1.0 && former > 0.0)) return {former, false};
  const double allowed = former * first * approach;
  return {allowed < smallest ? 0.0 : allowed, true};
}

// Slows down all robots in place.
struct SlowAllDown {
  double* first;     // (count,) first toi relative to the part that each robot was to move, inf for none; reset to inf
  double* fraction;  // (count,) part of the step that each robot moves
  uint8_t* changed;  // (count,)
  int64_t count;
  double approach;  // fraction of the toi by which a robot moves
  double smallest;  // a robot with a smaller fraction does not move at all

  // Returns whether the robot changes.
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

// Contacts (count,) of pairs of copies of robots; padding has negative pairs.
struct FirstToiInput {
  const int64_t* robots;  // robot of each copy; null if copies are robots
  const int64_t* pairs;   // (count, 2) copies
  const double* toi;      // (count,) >= 0
  int64_t count;
  int64_t copy_count, robot_count;

  // True if one side of a pair (of 2 count) is padding or a copy of a robot.
  PGCCD_HD bool is_sound(int64_t side) const {
    const int64_t copy = pairs[side];
    if (copy < 0) return true;
    return copy < copy_count && robot(copy) >= 0 && robot(copy) < robot_count;
  }

  PGCCD_HD int64_t robot(int64_t copy) const { return robots != nullptr ? robots[copy] : copy; }
};

// Pairs with at least one changed robot, of robots that move by different fractions. Two that move by the same fraction
// are at equal times of their whole paths, where the search of the whole step has certified them until its first toi,
// beyond the fraction of both.
struct AffectedPairs {
  const int64_t* pairs;    // (pair_count, 2), padding negative
  const uint8_t* changed;  // (robot_count,)
  const double* fraction;  // (robot_count,)
  int64_t robot_count;

  PGCCD_HD bool is_sound(int64_t pair) const {
    const int64_t i = pairs[2 * pair], j = pairs[2 * pair + 1];
    return i < 0 || (i < robot_count && j >= 0 && j < robot_count);
  }

  PGCCD_HD bool operator()(int64_t pair) const {
    const int64_t i = pairs[2 * pair];
    if (i < 0) return false;
    const int64_t j = pairs[2 * pair + 1];
    return (changed[i] | changed[j]) != 0 && fraction[i] != fraction[j];
  }
};

// Stores the counts of `found` pairs, of which at most `capacity` are written; all other counts are 0.
PGCCD_HD void store_counts(int64_t found, int64_t capacity, int64_t* counts) {
  for (int count = 0; count < kPairCounts; ++count) counts[count] = 0;
  counts[kPairsNeeded] = found;
  counts[kPairsWritten] = found < capacity ? found : capacity;
  counts[kPairsOverflow] = found > capacity ? 1 : 0;
}

}  // namespace pgccd
