// Output of the broad phases.
#pragma once

#include <cstdint>
#include <functional>

#include "core/scalar.h"
#include "kernels/padded_pairs.h"

namespace pgccd {

// Called once with the number of pairs; returns the memory for their rows (i, j): i < j, sorted by i, then j.
using PairOutput = std::function<int64_t*(int64_t count)>;

// A packed pair: the smaller index in the upper half.
PGCCD_HD uint64_t pack_pair(int32_t a, int32_t b) {
  return (static_cast<uint64_t>(smaller(a, b)) << 32) | static_cast<uint32_t>(larger(a, b));
}
PGCCD_HD int32_t first_of(uint64_t pair) { return static_cast<int32_t>(pair >> 32); }
PGCCD_HD int32_t second_of(uint64_t pair) { return static_cast<int32_t>(pair & 0xffffffffu); }

}  // namespace pgccd
