// Boxes of swept spheres, used to distribute bodies over ranks.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/executor.h"

namespace pgccd {

// lower and upper (count, 3): the box of every CBV grown by half of separation and tolerance. Boxes of potentially
// colliding pairs overlap (closed, as rounded), since rounding is monotone.
void swept_boxes_cpu(const Executor& executor, const BroadBodies& bodies, double* lower, double* upper);

}  // namespace pgccd
