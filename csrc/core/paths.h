// Straight paths, and how far from the origin they may lead.
#pragma once

#include "core/platform.h"

namespace pgccd {

constexpr double kLargestCoordinate = 1e150;  // squares of larger numbers overflow

// The point at a fraction of a straight path: exactly its ends at 0 and 1. `start` may be at rest before an invalid
// end.
PGCCD_HD double point_on_path(double fraction, double start, double end) {
  if (fraction == 1.0) return end;
  return fraction == 0.0 ? start : start + fraction * (end - start);
}

}  // namespace pgccd
