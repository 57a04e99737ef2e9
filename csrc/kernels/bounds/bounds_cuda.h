// Bounds on the device.
#pragma once

#include "kernels/bounds/bounds.h"
#include "kernels/device_context.h"

namespace pgccd {

void rotations_between_cuda(const DeviceContext& context, const double* orientation_t0, const double* orientation_t1,
                            int64_t count, double* rotation);

void refit_cuda(const DeviceContext& context, const DeformingInput& input, const DeformingBounds& bounds);

// The first of `count` rows that is not fit; `count` if all are.
void first_unfit_row_cuda(const DeviceContext& context, const FitnessColumn& column, int64_t count, int64_t* first);

}  // namespace pgccd
