// Traversal on the device.
#pragma once

#include <functional>

#include "core/candidate.h"
#include "kernels/device_context.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

// Called once with the number of candidates; returns where they go. Their order is not specified.
using CandidateOutput = std::function<Candidate*(int64_t count)>;

// As traverse_cpu. Writes the number of node tests to `node_tests` (device). Synchronises to read the number of
// candidates.
template <class Bodies>
void traverse_cuda(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                   const CandidateOutput& make_output, int64_t* node_tests);

// As traverse_cuda for the first *pair_count (device) of input.pair_count rows. The candidates live as long as the
// context's memory.
template <class Bodies>
CandidateSpan traverse_padded(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                              const int64_t* pair_count, const TraverseCapacity& capacity, int64_t* counts);

}  // namespace pgccd
