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

// Searches a first part of the candidates. Returns the bits of the earliest toi found of each pair, all ones for none
// (device, pair_count).
using SearchFirstPart = std::function<const unsigned long long*(const CandidateSpan& candidates)>;

// As traverse_cuda for the first *pair_count (device) of input.pair_count rows. The candidates live as long as the
// context's memory. With `search`, only the first contact of each pair is wanted: candidates of the leaves that may
// meet first are searched before others are listed, and of the rest only those that may touch until the contact found
// are returned.
template <class Bodies>
CandidateSpan traverse_padded(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                              const int64_t* pair_count, const TraverseCapacity& capacity, int64_t* counts,
                              const SearchFirstPart& search = nullptr);

}  // namespace pgccd
