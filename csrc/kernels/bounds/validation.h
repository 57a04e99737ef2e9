// Validation of the rows of the input.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "core/bodies.h"
#include "core/paths.h"
#include "core/platform.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

enum class RowCheck : int32_t {
  kMagnitude = 0,   // of each number: at most the limit
  kUnitLength = 1,  // differs from 1 by at most the limit
  kLength = 2,      // at most the limit
  kRange = 3,       // of each number: from 0 to the limit
  kSize = 4,        // of each number: 0, or from kRadiusOfPoint to the limit
};

// Limits of the columns of motions and scenes.
constexpr double kUnitTolerance = 1e-3;
constexpr double kLargestTurn = 1e6;  // error bounds of sine and cosine are proven up to it

struct RowColumn {
  const double* values;  // (rows, width)
  int64_t rows;
  int32_t width;
  RowCheck check;
  double limit;
  const int32_t* integers = nullptr;  // (rows,) in place of values, of the check kRange
};

// NaN is invalid.
PGCCD_HD bool is_invalid(const RowColumn& column, int64_t row) {
  if (column.integers != nullptr) return !(column.integers[row] >= 0 && column.integers[row] <= column.limit);
  const double* values = column.values + row * column.width;
  double squared = 0.0;
  bool small = true, positive = true, has_size = true;
  for (int k = 0; k < column.width; ++k) {
    small &= std::fabs(values[k]) <= column.limit;
    positive &= values[k] >= 0.0;
    has_size &= values[k] == 0.0 || values[k] >= kRadiusOfPoint;
    squared += values[k] * values[k];
  }
  if (column.check == RowCheck::kMagnitude) return !small;
  if (column.check == RowCheck::kRange) return !(small && positive);
  if (column.check == RowCheck::kSize) return !(small && has_size);
  const double length = std::sqrt(squared);
  return !((column.check == RowCheck::kUnitLength ? std::fabs(length - 1.0) : length) <= column.limit);
}

// SBV radii of bodies, one a row of each column: those given, else those of the meshes that the bodies name. -infinity
// for bodies with an invalid row: these are absent from broad phases.
struct SoundRadii {
  const double* given = nullptr;        // (count,) or null
  const double* of_meshes = nullptr;    // (mesh_count,)
  const int32_t* mesh_index = nullptr;  // (count,), may be invalid
  int64_t mesh_count = 0;
  double* out = nullptr;  // (count,) or null: none are found
  int64_t count = 0;
};

// The radius of a body, unless a row of it is invalid.
PGCCD_HD double radius_of(const SoundRadii& radii, int64_t body) {
  if (radii.given != nullptr) return radii.given[body];
  const int32_t mesh = radii.mesh_index[body];
  return mesh >= 0 && mesh < radii.mesh_count ? radii.of_meshes[mesh] : -INFINITY;
}

// Writes to `first` the first invalid row of each column, or its number of rows; then 1 if any row is invalid, else 0.
void first_invalid_rows(const Executor& executor, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first);
// At most kMostColumns.
void first_invalid_rows(const DeviceContext& context, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first);
constexpr int kMostColumns = 8;

}  // namespace pgccd
