// Body pairs in a buffer of fixed capacity; their number is on the device.
#pragma once

#include <cstdint>

namespace pgccd {

// Capacity of a PCS whose size is not read by the host.
struct PairCapacity {
  int64_t pairs;
  int64_t overlaps;  // overlapping boxes, tested by the predicate
  bool long_rows;    // whether one body may have more partners than one thread sorts
};

// Counts of a broad phase. The first three are the capacities needed; the number of pairs may be too small if the
// overlaps did not fit. Times are nanoseconds of the device's clock.
enum PairCount : int {
  kPairsNeeded,
  kOverlapsNeeded,
  kLongRowsNeeded,
  kPairsWritten,
  kPairsOverflow,  // 1 if a capacity was exceeded, else 0
  kBroadBegan,
  kBroadEnded,
  kPairCounts
};

// Rows after the last pair are filled with -1.
struct PaddedPairs {
  PairCapacity capacity;
  int64_t* rows;    // (capacity.pairs, 2)
  int64_t* counts;  // (kPairCounts)
};

}  // namespace pgccd
