// Counters of lists with a capacity.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Lists have fewer than 2^31 rows, but rows beyond the capacity are counted without limit. 64 bits: a 32-bit count
// could wrap around and appear to fit.
using Counter = unsigned long long;  // the type of device atomics

constexpr int64_t kMostRows = 0x7fffff00;  // so that the sum of a row and a launch's threads fits 32 bits

// True if `at`, returned by a counter, is a valid index of a list with this capacity.
PGCCD_HD bool has_place(Counter at, int64_t capacity) { return at < static_cast<Counter>(capacity); }

// True if all counted rows fit.
PGCCD_HD bool fits(Counter count, int64_t capacity) { return count <= static_cast<Counter>(capacity); }

// A requested number of rows, clamped to [0, kMostRows].
PGCCD_HD uint32_t rows_of(int64_t wanted) {
  return static_cast<uint32_t>(wanted < 0 ? 0 : (wanted < kMostRows ? wanted : kMostRows));
}

}  // namespace pgccd
