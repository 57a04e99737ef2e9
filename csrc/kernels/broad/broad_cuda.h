// Broad phases on the device.
#pragma once

#include <functional>

#include "kernels/broad/body_volumes.h"
#include "kernels/device_context.h"

namespace pgccd {

// Called once with the number of pairs; returns where their rows (i, j) go.
using PairOutput = std::function<int64_t*(int64_t count)>;

// As sweep_cpu.
void sweep_cuda(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairOutput& make_output);

}  // namespace pgccd
