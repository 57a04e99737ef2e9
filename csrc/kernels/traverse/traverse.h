// Traversal: body pairs in, candidate feature pairs out.
#pragma once

#include <cstdint>
#include <vector>

#include "core/candidate.h"
#include "kernels/executor.h"
#include "kernels/traverse/pair_sweep.h"

namespace pgccd {

struct TraverseInput {
  const int64_t* pairs;  // (pair_count, 2) body indices
  int64_t pair_count;
  const double* horizon;  // (pair_count,) look no further than this time, or null: the whole step
  SweepSettings settings;
  bool leading;  // only the leaf pair that overlaps most, found by greedy descent: where contact is likely first
};

struct CandidateList {
  std::vector<std::vector<Candidate>> parts;  // one after the other: by pair
  int64_t node_tests = 0;

  int64_t size() const {
    int64_t total = 0;
    for (const auto& part : parts) total += static_cast<int64_t>(part.size());
    return total;
  }
};

// Every feature pair that may come within separation + tolerance until the horizon is listed, and none twice; unless
// `leading`.
template <class Bodies>
CandidateList traverse_cpu(const Executor& executor, const Bodies& bodies, const TraverseInput& input);

}  // namespace pgccd
