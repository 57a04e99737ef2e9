// How every broad phase hands over the PCS.
#pragma once

#include <cstdint>
#include <functional>

#include "core/scalar.h"

namespace pgccd {

// Called once with the number of pairs; returns where their rows (i, j) go: i < j, sorted by i, then j.
using PairOutput = std::function<int64_t*(int64_t count)>;

// Room for a PCS whose size nobody waits for.
struct PairCapacity {
  int64_t pairs;
  int64_t overlaps;  // of boxes, which are then looked at more closely
  bool long_rows;    // may one body have more partners than one thread sorts quickly?
};

// What a broad phase counted. The first three say what room it needed; the number of pairs may be too small where the
// overlaps did not fit. Times are nanoseconds of the device's clock.
enum PairCount : int {
  kPairsNeeded,
  kOverlapsNeeded,
  kLongRowsNeeded,
  kPairsWritten,
  kPairsOverflow,  // 1 if there was not room for all, else 0
  kBroadBegan,
  kBroadEnded,
  kPairCounts
};

// Rows after the last pair written are filled with -1.
struct PaddedPairs {
  PairCapacity capacity;
  int64_t* rows;    // (capacity.pairs, 2)
  int64_t* counts;  // (kPairCounts)
};

// A pair while it is collected: the smaller index in the upper half.
PGCCD_HD uint64_t pack_pair(int32_t a, int32_t b) {
  return (static_cast<uint64_t>(smaller(a, b)) << 32) | static_cast<uint32_t>(larger(a, b));
}
PGCCD_HD int32_t first_of(uint64_t pair) { return static_cast<int32_t>(pair >> 32); }
PGCCD_HD int32_t second_of(uint64_t pair) { return static_cast<int32_t>(pair & 0xffffffffu); }

}  // namespace pgccd
