// Broad phases on the CPU: swept spheres in, potentially colliding set (PCS) out.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/broad/broad_phase.h"
#include "kernels/broad/pair_output.h"
#include "kernels/executor.h"

namespace pgccd {

// Runs the chosen broad phase.
void find_pairs_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                    const PairOutput& make_output);

// Sweep and prune.
void sweep_cpu(const Executor& executor, const BroadBodies& bodies, int axis, const PairOutput& make_output);

// Hashed grid with a level for each octave of body sizes.
void grid_cpu(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);

// Linear bounding volume hierarchy.
void lbvh_cpu(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);

}  // namespace pgccd
