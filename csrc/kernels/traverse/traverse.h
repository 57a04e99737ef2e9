// Traversal: body pairs in, candidate feature pairs out.
#pragma once

#include <cstdint>
#include <vector>

#include "core/candidate.h"
#include "kernels/executor.h"
#include "kernels/traverse/pair_sweep.h"

namespace pgccd {

struct CandidateList {
  std::vector<std::vector<Candidate>> parts;  // one after the other: by pair
  int64_t node_tests = 0;

  int64_t size() const {
    int64_t total = 0;
    for (const auto& part : parts) total += static_cast<int64_t>(part.size());
    return total;
  }
};

// pairs: (pair_count, 2) body indices. Every feature pair that may touch within `separation` is listed exactly once.
template <class Bodies>
CandidateList traverse_cpu(const Executor& executor, const Bodies& bodies, const int64_t* pairs, int64_t pair_count,
                           double separation);

}  // namespace pgccd
