// How devices count what may not fit.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Lists have fewer than 2^31 rows, but what would have been put into them is counted on: there may be any number of it.
// In 64 bits no count wraps around, to look like one that fits.
using Counter = unsigned long long;  // the name that device atomics know

constexpr int64_t kMostRows = 0x7fffff00;  // so that the sum of a row and a launch's threads has 32 bits

// Is the place `at`, which a counter gave out, one of a list of that size?
PGCCD_HD bool has_place(Counter at, int64_t capacity) { return at < static_cast<Counter>(capacity); }

// Was there a place for all that was counted?
PGCCD_HD bool fits(Counter count, int64_t capacity) { return count <= static_cast<Counter>(capacity); }

// Rows of a list of which so many were asked for.
PGCCD_HD uint32_t rows_of(int64_t wanted) {
  return static_cast<uint32_t>(wanted < 0 ? 0 : (wanted < kMostRows ? wanted : kMostRows));
}

}  // namespace pgccd
