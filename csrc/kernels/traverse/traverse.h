// Traversal: body pairs in, candidate feature pairs out.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "core/candidate.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/traverse/pair_item.h"

namespace pgccd {

struct TraverseInput {
  const int64_t* pairs;  // (pair_count, 2) body indices
  int64_t pair_count;
  const double* horizon;  // (pair_count,) end of the time searched; null: the whole step
  SweepSettings settings;
};

// The horizon of a body pair; values outside of [0, 1] mean the whole step.
PGCCD_HD double horizon_of(const TraverseInput& input, int64_t pair) {
  const double horizon = input.horizon != nullptr ? input.horizon[pair] : 1.0;
  return horizon >= 0.0 && horizon <= 1.0 ? horizon : 1.0;
}

// Capacity of a traversal that does not synchronise.
struct TraverseCapacity {
  int64_t poses;  // of body pairs with several segments: at all boundaries of these
  int64_t tasks;  // node pairs with which a launch starts
  int64_t leaf_pairs;
  int64_t candidates;
  int64_t launches;  // after the first
  bool crowded;      // a body pair may have very many candidates: see SearchFirstPart
};

// Counts of a traversal: the capacity needed (as far as it ran), and the numbers of node pairs left after the last
// launch and of node tests. Times as for the broad phase.
enum TraverseCount : int {
  kPosesNeeded,
  kTasksNeeded,
  kLeafPairsNeeded,
  kCandidatesNeeded,
  kTasksLeft,
  kNodeTests,
  kCrowded,           // 1 if fewer candidates may do in a crowded search, else 0
  kTraverseOverflow,  // 1 if a capacity was exceeded or tasks are left, else 0
  kTraverseBegan,
  kTraverseEnded,
  kTraverseCounts
};

// Called once with the number of candidates; returns where they go.
using CandidateOutput = std::function<Candidate*(int64_t count)>;

// Lists every feature pair that may come within separation + tolerance until the horizon exactly once: by body pair on
// the CPU, in any order on a device. Writes the number of node tests (1,). A device synchronises to read the number of
// candidates.
template <class Bodies>
void traverse(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
              const CandidateOutput& make_output, int64_t* node_tests);
template <class Bodies>
void traverse(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
              const CandidateOutput& make_output, int64_t* node_tests);

struct CandidateList {
  std::vector<std::vector<Candidate>> parts;  // one after the other: by pair
  int64_t node_tests = 0;

  int64_t size() const {
    int64_t total = 0;
    for (const auto& part : parts) total += static_cast<int64_t>(part.size());
    return total;
  }
};

template <class Bodies>
CandidateList list_candidates(const Executor& executor, const Bodies& bodies, const TraverseInput& input);

// Of these only the vertices that may be inside of a solid.
template <class Bodies>
CandidateList list_enclosures(const Executor& executor, const Bodies& bodies, const TraverseInput& input);

// The same in two stages, the first of which finds the pairs of leaves that may meet.
struct FoundLeaves {
  std::vector<LeafPair> pairs;  // by body pair
  int64_t node_tests = 0;
};
// `most_at_start`: a descent ends once it has found as many that begin at t = 0.
template <class Bodies>
FoundLeaves find_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                            size_t most_at_start);
// `over_same_time`: whether they were found over the motion until the same times.
template <class Bodies>
CandidateList visit_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                               const std::vector<LeafPair>& leaves, bool over_same_time);

// Searches a first part of the candidates: of the leaf pairs that may meet first in their body pair. In a crowded
// search, of body pairs with more than kFirstLeaves such leaf pairs, of about as many: bodies that rest against each
// other have thousands, and candidates of a few of them find a contact at t = 0 that leaves little to search.
using SearchFirstPart = std::function<FirstPart(const CandidateSpan& candidates)>;
constexpr uint32_t kFirstLeaves = 64;

// As traverse, for the first *pair_count (device) of input.pair_count rows, without synchronising. The candidates live
// as long as the context's memory. With `search`, only one contact of each pair is wanted: of many pairs, or if
// crowded, a first part of the candidates is searched before others are listed, and of the rest only those are returned
// that may come before the contacts found.
template <class Bodies>
CandidateSpan traverse_padded(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                              const int64_t* pair_count, const TraverseCapacity& capacity, int64_t* counts,
                              const SearchFirstPart& search = nullptr);

}  // namespace pgccd
