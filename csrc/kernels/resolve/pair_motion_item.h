// The shortened paths of the two bodies of each pair that a round of resolution searches.
#pragma once

#include "core/bodies.h"
#include "core/paths.h"
#include "kernels/padded_pairs.h"

namespace pgccd {

// Columns of rigid bodies and their motion, as of RigidBodies.
struct PairBodies {
  const int32_t* mesh_index;
  BodyCentres centres;  // by velocity: position_t1 has the displacement instead
  const double* orientation;
  const double* rotation;
};

// Rows 2 k and 2 k + 1 are the bodies of the k-th pair found.
struct PairMotion {
  int32_t* mesh_index;
  double* position_t0;
  double* position_t1;
  double* radius;
  double* orientation;
  double* rotation;
  double* margin;  // null if the bodies have none
};

// Pairs with a body that has changed.
struct ChangedPairs {
  const int64_t* pairs;    // (pair_count, 2), padding negative
  const uint8_t* changed;  // (body_count,)
  const double* fraction;  // (body_count,)
  int64_t body_count;
  // Leaves out pairs whose bodies move by the same fraction: they are at equal times of their whole paths, where the
  // search of the whole step has certified them until its first toi, beyond the fraction of both.
  bool skips_equal;

  PGCCD_HD bool is_sound(int64_t pair) const {
    const int64_t i = pairs[2 * pair], j = pairs[2 * pair + 1];
    return i < 0 || (i < body_count && j >= 0 && j < body_count);
  }

  PGCCD_HD bool operator()(int64_t pair) const {
    const int64_t i = pairs[2 * pair];
    if (i < 0) return false;
    const int64_t j = pairs[2 * pair + 1];
    return (changed[i] | changed[j]) != 0 && !(skips_equal && fraction[i] == fraction[j]);
  }
};

struct ShortenedPairs {
  ChangedPairs changed;
  int64_t pair_count;
  PairBodies own, ghosts;  // rows of ghosts follow those of own bodies
  const double* fraction;  // (own + ghosts)
  bool by_velocity;        // whether a body ends at start + fraction * displacement

  int64_t capacity;
  int64_t* pairs;  // (capacity, 2) pairs found; unused rows are not written, here and in the motion
  PairMotion motion;
  int64_t* counts;  // (kPairCounts)

  // Writes one body of a found pair to row `at`, unless that exceeds the capacity.
  PGCCD_HD void store(int64_t pair, int side, int64_t at) const {
    if (at >= capacity) return;
    const int64_t row = 2 * at + side, held = changed.pairs[2 * pair + side];
    pairs[row] = held;
    const bool is_ghost = held >= own.centres.count;
    const PairBodies& bodies = is_ghost ? ghosts : own;
    const int64_t body = is_ghost ? held - own.centres.count : held;
    motion.mesh_index[row] = bodies.mesh_index[body];
    motion.radius[row] = bodies.centres.radius[body];
    if (motion.margin != nullptr) motion.margin[row] = bodies.centres.margin[body];
    for (int k = 0; k < 4; ++k) motion.orientation[4 * row + k] = bodies.orientation[4 * body + k];
    const double part = fraction[held];
    for (int k = 0; k < 3; ++k) {
      const double start = bodies.centres.position_t0[3 * body + k], end = bodies.centres.position_t1[3 * body + k];
      const double turn = bodies.rotation[3 * body + k];
      motion.position_t0[3 * row + k] = start;
      motion.position_t1[3 * row + k] = by_velocity ? start + part * end : point_on_path(part, start, end);
      motion.rotation[3 * row + k] = by_velocity ? part * turn : point_on_path(part, 0.0, turn);
    }
  }

  // Stores the counts of `found` pairs, of which at most `capacity` are written; all other counts are 0.
  PGCCD_HD void store_counts(int64_t found) const {
    for (int count = 0; count < kPairCounts; ++count) counts[count] = 0;
    counts[kPairsNeeded] = found;
    counts[kPairsWritten] = found < capacity ? found : capacity;
    counts[kPairsOverflow] = found > capacity ? 1 : 0;
  }
};

}  // namespace pgccd
