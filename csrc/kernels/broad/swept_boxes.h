// Boxes of swept spheres, for distributing bodies over ranks.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/executor.h"

namespace pgccd {

// lower and upper (count, 3): the box of every CBV with half the separation. Boxes of pairs that are potentially
// colliding overlap (closed, as rounded): both ends of exact boxes are rounded alike, which keeps their order.
void swept_boxes_cpu(const Executor& executor, const BroadBodies& bodies, double* lower, double* upper);

}  // namespace pgccd
