// Body pairs in a buffer of fixed capacity; their number stays on the device.
#pragma once

#include <cstdint>

namespace pgccd {

// Capacity of a PCS whose size the host does not wait for.
struct PairCapacity {
  int64_t pairs;
  int64_t overlaps;  // of boxes, which are then looked at more closely
  bool long_rows;    // may one body have more partners than one thread sorts quickly?
};

// What a broad phase counted. The first three are the capacities it needed; the number of pairs may be too small where
// the overlaps did not fit. Times are nanoseconds of the device's clock.
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

// Rows after the last pair written are filled with -1.
struct PaddedPairs {
  PairCapacity capacity;
  int64_t* rows;    // (capacity.pairs, 2)
  int64_t* counts;  // (kPairCounts)
};

}  // namespace pgccd
