// Broad phases on the device: the rows of broad.h.
#pragma once

#include <variant>

#include "kernels/broad/body_volumes.h"
#include "kernels/broad/broad_phase.h"
#include "kernels/broad/pair_output.h"
#include "kernels/device_context.h"

namespace pgccd {

// An output of exactly the size needed, whose count the host waits for; or a padded one, without waiting.
using PairSink = std::variant<PairOutput, PaddedPairs>;

// By the one chosen.
void find_pairs_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                     const PairSink& out);

void sweep_cuda(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairSink& out);
void grid_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);
void lbvh_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);

}  // namespace pgccd
