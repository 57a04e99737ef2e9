// Which rows of a column cannot be worked with: poses that are not finite, orientations that are not unit quaternions.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/platform.h"

namespace pgccd {

enum class Fitness : int64_t {
  kBounded = 0,  // every number's magnitude is at most the limit
  kUnit = 1,     // the row's length differs from 1 by at most the limit
  kShort = 2,    // the row's length is at most the limit
};

struct FitnessColumn {
  const double* values;  // (count, width)
  int64_t width;
  Fitness kind;
  double limit;
};

PGCCD_HD bool is_fit(const FitnessColumn& column, int64_t row) {
  const double* values = column.values + row * column.width;
  double squared = 0.0;
  bool bounded = true;
  for (int64_t k = 0; k < column.width; ++k) {
    bounded = bounded && std::fabs(values[k]) <= column.limit;  // NaN counts as too large
    squared += values[k] * values[k];
  }
  if (column.kind == Fitness::kBounded) return bounded;
  const double length = std::sqrt(squared);
  return column.kind == Fitness::kUnit ? std::fabs(length - 1.0) <= column.limit : length <= column.limit;
}

}  // namespace pgccd
