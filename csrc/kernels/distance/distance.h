// Distance of two bodies over a step: a lower and an upper bound of the least distance that their surfaces have at
// equal times.
#pragma once

#include <cstdint>

#include "core/bodies.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

struct DistanceInput {
  const int64_t* pairs;  // (pair_count, 2) body indices
  int64_t pair_count;
  double cutoff;     // of thickened surfaces; pairs certainly further apart are searched no further
  double tolerance;  // as in `distance_tolerance`: a search ends when the bounds are so close
};

// Rows of the outputs.
struct DistanceColumns {
  double* lower;   // (pair_count,)
  double* upper;   // (pair_count,) infinite if the pair is beyond the cutoff
  double* time;    // (pair_count,) at which the upper bound is attained; NaN if there is none
  double* points;  // (pair_count, 2, 3) of both surfaces, without margins, world frame; NaN if there are none
};

template <class Bodies>
void distances(const Executor& executor, const Bodies& bodies, const DistanceInput& input, const DistanceColumns& out);
template <class Bodies>
void distances(const DeviceContext& context, const Bodies& bodies, const DistanceInput& input,
               const DistanceColumns& out);

}  // namespace pgccd
