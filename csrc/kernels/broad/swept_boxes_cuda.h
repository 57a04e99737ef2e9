// Boxes of swept spheres on the device.
#pragma once

#include "kernels/broad/body_volumes.h"
#include "kernels/device_context.h"

namespace pgccd {

// As swept_boxes_cpu.
void swept_boxes_cuda(const DeviceContext& context, const BroadBodies& bodies, double* lower, double* upper);

}  // namespace pgccd
