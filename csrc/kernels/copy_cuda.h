// Copies within a device.
#pragma once

#include <cstdint>

#include "kernels/device_context.h"

namespace pgccd {

void copy_counts_cuda(const DeviceContext& context, const int64_t* from, int64_t count, int64_t* to);

}  // namespace pgccd
