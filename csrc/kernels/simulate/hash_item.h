// The hash of a row of columns; rows are summed modulo 2^64, so that the sum depends neither on their order nor on the
// ranks that hold them. And the other sums of a step.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Columns of 8-byte numbers, processed as bits.
struct HashColumns {
  static constexpr int kMost = 8;
  const uint64_t* column[kMost];
  int64_t width[kMost];  // numbers per row
  int columns;
  int64_t count;  // rows
};

// SplitMix64 (Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195).
PGCCD_HD uint64_t mix(uint64_t bits) {
  bits += 0x9e3779b97f4a7c15u;
  bits = (bits ^ (bits >> 30)) * 0xbf58476d1ce4e5b9u;
  bits = (bits ^ (bits >> 27)) * 0x94d049bb133111ebu;
  return bits ^ (bits >> 31);
}

PGCCD_HD uint64_t row_hash(const HashColumns& columns, int64_t row) {
  uint64_t hash = 0;
  for (int k = 0; k < columns.columns; ++k) {
    const int64_t width = columns.width[k];
    for (int64_t at = 0; at < width; ++at) hash = mix(hash ^ columns.column[k][row * width + at]);
  }
  return hash;
}

// Values in the order of `simulate_tally`; hashes modulo 2^64.
struct StepTally {
  int64_t robots;
  uint64_t contacts_hash;
  uint64_t state_hash;
  int64_t stopped;
  int64_t touching;  // at the start of the step
  uint64_t id_hash;
};
constexpr int kTallyCounts = sizeof(StepTally) / sizeof(int64_t);

// Outcome of a step: robots after it, the part that each moved, and contacts, which may be padded with negative pairs.
struct StepOutcome {
  HashColumns state;       // the first column: ids
  const double* fraction;  // (state.count,)
  const int64_t* id;       // (id_count,) ids of the robots that pairs index
  int64_t id_count;
  const int64_t* pairs;  // (contact_count, 2)
  const double* toi;     // (contact_count,)
  int64_t contact_count;

  PGCCD_HD bool is_sound(int64_t contact) const {
    const int64_t i = pairs[2 * contact], j = pairs[2 * contact + 1];
    return i < 0 || (i < id_count && j >= 0 && j < id_count);
  }
  // Rows with negative ids are padding.
  PGCCD_HD void add_robot(int64_t row, StepTally& tally) const {
    if (static_cast<int64_t>(state.column[0][row]) < 0) return;
    ++tally.robots;
    tally.state_hash += row_hash(state, row);
    tally.stopped += fraction[row] < 1.0 ? 1 : 0;
    tally.id_hash += mix(state.column[0][row]);
  }
  PGCCD_HD void add_contact(int64_t row, StepTally& tally) const {
    if (pairs[2 * row] < 0) return;
    const int64_t i = id[pairs[2 * row]], j = id[pairs[2 * row + 1]];
    union {
      double number;
      uint64_t bits;
    } time{toi[row]};
    const uint64_t lower = static_cast<uint64_t>(i < j ? i : j), upper = static_cast<uint64_t>(i < j ? j : i);
    tally.contacts_hash += mix(mix(mix(lower) ^ upper) ^ time.bits);
    tally.touching += time.number == 0.0 ? 1 : 0;
  }
};

}  // namespace pgccd
