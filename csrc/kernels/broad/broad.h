// Broad phases on the CPU: swept spheres in, potentially colliding set (PCS) out. All of them hand over the same rows:
// every pair with is_potentially_colliding, sorted.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/broad/pair_output.h"
#include "kernels/executor.h"

namespace pgccd {

// Sweep and prune. axis: 0, 1, 2, or -1 for that of the largest variance of centres.
void sweep_cpu(const Executor& executor, const BroadBodies& bodies, int axis, const PairOutput& make_output);

// Hashed grid with a level for each octave of body sizes.
void grid_cpu(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);

// Linear bounding volume hierarchy.
void lbvh_cpu(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);

}  // namespace pgccd
