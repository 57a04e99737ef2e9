// Checks of rows on the device.
#pragma once

#include "kernels/device_context.h"
#include "kernels/row_checks.h"

namespace pgccd {

// Throws an error if one of the candidates (count,) is invalid. Synchronises.
template <class Bodies>
void require_candidates_cuda(const DeviceContext& context, const Bodies& bodies, const NamedPairs& pairs,
                             const Candidate* candidates, int64_t count);

// Asserts on the device that the first *given of `most` rows (., 2) are below `limit`.
void require_owners_cuda(const DeviceContext& context, const int64_t* owners, const int64_t* given, int64_t most,
                         int64_t limit);

}  // namespace pgccd
