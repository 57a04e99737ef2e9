// Pairs of a broad phase `at_any_times`, of which those that meet at equal times are selected.
#pragma once

#include "kernels/broad/box_item.h"

namespace pgccd {

struct SweptPairs {
  BroadBodies bodies;
  const int64_t* rows;  // (count, 2), padding negative
  int64_t count;
};

// True for padding, or for a pair of valid bodies.
PGCCD_HD bool is_sound(const SweptPairs& pairs, int64_t k) {
  const int64_t i = pairs.rows[2 * k], j = pairs.rows[2 * k + 1];
  return i < 0 || (is_within(i, pairs.bodies.count) && is_within(j, pairs.bodies.count));
}

PGCCD_HD bool meets(const SweptPairs& pairs, int64_t k) {
  const int64_t i = pairs.rows[2 * k], j = pairs.rows[2 * k + 1];
  return i >= 0 && is_potentially_colliding(pairs.bodies, smaller(i, j), larger(i, j));
}

// Stores the k-th pair that meets; `found` (found_count,) are the indices of all.
PGCCD_HD void store_meeting_pair(const SweptPairs& pairs, const int64_t* found, int64_t found_count, int64_t k,
                                 int64_t* out) {
  const bool is_pair = k < found_count;
  out[2 * k] = is_pair ? pairs.rows[2 * found[k]] : -1;
  out[2 * k + 1] = is_pair ? pairs.rows[2 * found[k] + 1] : -1;
}

}  // namespace pgccd
