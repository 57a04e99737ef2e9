// Broad phases on the device: the rows of broad.h.
#pragma once

#include <variant>

#include "kernels/broad/body_volumes.h"
#include "kernels/broad/broad_phase.h"
#include "kernels/broad/pair_output.h"
#include "kernels/device_context.h"

namespace pgccd {

// An output of exactly the size needed, whose count the host reads; or a padded one, without synchronising.
using PairSink = std::variant<PairOutput, PaddedPairs>;

// Runs the chosen broad phase.
void find_pairs_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                     const PairSink& out);

// At least two bodies; called by `find_pairs_cuda`.
void sweep_cuda(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairSink& out);
void grid_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);
void lbvh_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);

}  // namespace pgccd
