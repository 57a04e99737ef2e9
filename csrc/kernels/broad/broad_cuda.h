// Broad phases on the device: the rows of broad.h.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/broad/pair_output.h"
#include "kernels/device_context.h"

namespace pgccd {

void sweep_cuda(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairOutput& make_output);
void grid_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairOutput& make_output);
void lbvh_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairOutput& make_output);

}  // namespace pgccd
