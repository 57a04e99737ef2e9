// How devices count what may not fit.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Lists have fewer than 2^31 rows, but what would have been put into them is counted on: there may be any number of it.
// 64 bits: a 32-bit count could wrap around and seem to fit.
using Counter = unsigned long long;  // the name that device atomics know

constexpr int64_t kMostRows = 0x7fffff00;  // so that the sum of a row and a launch's threads has 32 bits

// Is `at`, returned by a counter, a valid place of a list of that capacity?
PGCCD_HD bool has_place(Counter at, int64_t capacity) { return at < static_cast<Counter>(capacity); }

// Did everything that was counted fit?
PGCCD_HD bool fits(Counter count, int64_t capacity) { return count <= static_cast<Counter>(capacity); }

// A requested number of rows, clamped to what can be numbered.
PGCCD_HD uint32_t rows_of(int64_t wanted) {
  return static_cast<uint32_t>(wanted < 0 ? 0 : (wanted < kMostRows ? wanted : kMostRows));
}

}  // namespace pgccd
