// Traversal on the device.
#pragma once

#include <functional>

#include "core/candidate.h"
#include "kernels/device_context.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

// Called once with the number of candidates; returns where they go. Their order is not specified.
using CandidateOutput = std::function<Candidate*(int64_t count)>;

// As traverse_cpu. Writes the number of node tests to `node_tests` (device).
template <class Bodies>
void traverse_cuda(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                   const CandidateOutput& make_output, int64_t* node_tests);

}  // namespace pgccd
