// Narrow phase on the device.
#pragma once

#include <functional>

#include "kernels/device_context.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {

// Called once with the number of rows.
using ContactOutput = std::function<ContactColumns(int64_t count)>;

template <class Bodies>
void narrow_phase_cuda(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                       const ContactOutput& make_output);

template <bool kEdgeEdge>
void elementary_cuda(const DeviceContext& context, const double* points_t0, const double* points_t1, int64_t count,
                     const NarrowSettings& settings, int8_t* status, double* toi, double* coordinates);

}  // namespace pgccd
