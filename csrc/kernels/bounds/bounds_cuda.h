// Bounds on the device.
#pragma once

#include "kernels/bounds/bounds.h"
#include "kernels/device_context.h"

namespace pgccd {

void rotations_between_cuda(const DeviceContext& context, const double* orientation_t0, const double* orientation_t1,
                            int64_t count, double* rotation);

void poses_at_cuda(const DeviceContext& context, const RigidPoses& poses, int64_t count, double* position,
                   double* orientation);

void moving_spheres_cuda(const DeviceContext& context, const RigidBodies& bodies, int64_t count,
                         const MovingSpheres& out);

void refit_cuda(const DeviceContext& context, const DeformingInput& input, const DeformingBounds& bounds);

}  // namespace pgccd
