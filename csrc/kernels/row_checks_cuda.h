// Checks of rows on the device.
#pragma once

#include "kernels/device_context.h"
#include "kernels/row_checks.h"

namespace pgccd {

// Throws an error if one of the candidates (count,) names what is not there. Waits for the device.
template <class Bodies>
void require_candidates_cuda(const DeviceContext& context, const Bodies& bodies, const NamedPairs& pairs,
                             const Candidate* candidates, int64_t count);

// Ends with an assertion on the device unless the first *given of `most` rows (., 2) name rows below `limit`.
void require_owners_cuda(const DeviceContext& context, const int64_t* owners, const int64_t* given, int64_t most,
                         int64_t limit);

}  // namespace pgccd
