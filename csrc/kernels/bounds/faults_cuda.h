// Faults on the device.
#pragma once

#include "kernels/bounds/faults.h"
#include "kernels/device_context.h"

namespace pgccd {

// As first_faults_cpu; at most kMostColumns.
constexpr int kMostColumns = 8;
void first_faults_cuda(const DeviceContext& context, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                       int64_t* first);

}  // namespace pgccd
