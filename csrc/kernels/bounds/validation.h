// Validation of the rows of the input.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "core/platform.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

enum class RowCheck : int32_t {
  kMagnitude = 0,   // of each number: at most the limit
  kUnitLength = 1,  // differs from 1 by at most the limit
  kLength = 2,      // at most the limit
  kRange = 3,       // of each number: from 0 to the limit
};

struct RowColumn {
  const double* values;  // (rows, width)
  int64_t rows;
  int32_t width;
  RowCheck check;
  double limit;
};

// NaN is invalid.
PGCCD_HD bool is_invalid(const RowColumn& column, int64_t row) {
  const double* values = column.values + row * column.width;
  double squared = 0.0;
  bool small = true, positive = true;
  for (int k = 0; k < column.width; ++k) {
    small &= std::fabs(values[k]) <= column.limit;
    positive &= values[k] >= 0.0;
    squared += values[k] * values[k];
  }
  if (column.check == RowCheck::kMagnitude) return !small;
  if (column.check == RowCheck::kRange) return !(small && positive);
  const double length = std::sqrt(squared);
  return !((column.check == RowCheck::kUnitLength ? std::fabs(length - 1.0) : length) <= column.limit);
}

// A copy of radii of bodies, one a row of each column, with -infinity for bodies with an invalid row: these are absent
// from broad phases.
struct SoundRadii {
  const double* radius = nullptr;  // (count,)
  double* copy = nullptr;          // (count,) or null: none is made
  int64_t count = 0;
};

// Writes to `first` the first invalid row of each column, or its number of rows; then 1 if any row is invalid, else 0.
void first_invalid_rows(const Executor& executor, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first);
// At most kMostColumns.
void first_invalid_rows(const DeviceContext& context, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first);
constexpr int kMostColumns = 8;

}  // namespace pgccd
