// The broad phases. All of them return the same rows: every pair with is_potentially_colliding, sorted.
#pragma once

#include <cstdint>

namespace pgccd {

// Names in the same order: pgccd/detection/broad.py.
enum class BroadPhase : int64_t {
  kSweep = 0,
  kGrid = 1,
  kLbvh = 2,
};
constexpr int64_t kBroadPhases = 3;

struct BroadPhaseChoice {
  BroadPhase phase;
  int axis = -1;  // of a sweep: 0, 1, 2, or -1 for the axis with the largest variance of centres
};

}  // namespace pgccd
