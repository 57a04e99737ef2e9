// Broad phase: swept spheres in, potentially colliding set (PCS) out.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels/broad/body_volumes.h"
#include "kernels/executor.h"

namespace pgccd {

struct BodyPair {
  int64_t i, j;  // i < j
};

// All pairs with is_potentially_colliding, sorted. axis: 0, 1, 2, or -1 for that of the largest variance of centres.
std::vector<BodyPair> sweep_cpu(const Executor& executor, const BroadBodies& bodies, int axis);

}  // namespace pgccd
