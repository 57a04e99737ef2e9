// Stores the box of one swept sphere in two tables.
#pragma once

#include "kernels/broad/body_volumes.h"

namespace pgccd {

PGCCD_HD void store_swept_box(const BroadBodies& bodies, int64_t body, double* lower, double* upper) {
  const SweptBox box = swept_box(bodies, body);
  lower[3 * body] = box.lower.x;
  lower[3 * body + 1] = box.lower.y;
  lower[3 * body + 2] = box.lower.z;
  upper[3 * body] = box.upper.x;
  upper[3 * body + 1] = box.upper.y;
  upper[3 * body + 2] = box.upper.z;
}

}  // namespace pgccd
