// Counters of a traversal on a device, and its capacities. Overflow is determined from the counts alone.
#pragma once

#include "core/candidate.h"
#include "core/scalar.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

struct TraverseCounters {
  Counter rest[3];  // tasks returned: launches rotate, see TaskHandover
  Counter most_rest;
  Counter leaves, meeting_leaves;  // leaf pairs found by the descent; those left by culling
  // Of these, the ones that begin first in their body pair, the others, and those of the others that still may meet.
  Counter first_leaves, later_leaves, remaining_leaves;
  CandidateCounts candidates;           // edge-edge at the front, vertex-face at the back
  CandidateCounts searched_candidates;  // those of the first leaf pairs
  CandidateCounts no_candidates;        // zero
  int64_t search_time;                  // of the candidates of the first leaf pairs, nanoseconds
  Counter poses;
  Counter node_tests;
  Counter self_pairs;      // see SelfPairs
  Counter self_blocks;     // of all of these pairs
  Counter has_fast_pairs;  // pairs that turn fast, or would
  Counter unsound;         // rows with invalid bodies, or bodies with invalid meshes
  uint32_t taken[3];       // tasks taken, of those stored
};

// Blocks of all bodies tested against themselves have 32-bit numbers.
constexpr int64_t kMostSelfBlocks = 0xffffffff;

struct TraverseListSizes {
  uint32_t poses, tasks, leaves, candidates;

  // Of the tasks, only those passed from one launch to the next use capacity.
  PGCCD_HD bool holds(const TraverseCounters& seen) const {
    return fits(seen.poses, poses) && fits(seen.most_rest, tasks) && fits(seen.leaves, leaves) &&
           fits(seen.candidates.sum(), candidates) && fits(seen.self_blocks, kMostSelfBlocks);
  }

  // Whether a larger capacity can help.
  bool can_grow(const TraverseCounters& seen) const {
    return fits(seen.poses, kMostRows) && fits(seen.most_rest, kMostRows) && fits(seen.leaves, kMostRows) &&
           fits(seen.candidates.sum(), kMostRows) && fits(seen.self_blocks, kMostSelfBlocks);
  }
  void grow(const TraverseCounters& seen) {
    poses = grown(seen.poses, poses);
    tasks = grown(seen.most_rest, tasks);
    leaves = grown(seen.leaves, leaves);
    candidates = grown(seen.candidates.sum(), candidates);
  }

 private:
  static uint32_t grown(Counter needed, uint32_t capacity) {
    if (fits(needed, capacity)) return capacity;
    return rows_of(fits(needed, kMostRows) ? static_cast<int64_t>(needed + needed / 4) : kMostRows);
  }
};

// Stores all counts (kTraverseCounts) except times; `last`: index in `rest` of the last launch's remaining tasks.
PGCCD_HD void store_traverse_counts(const TraverseCounters& seen, const TraverseListSizes& capacity, int last,
                                    int64_t* counts) {
  const Counter left = seen.rest[last];
  counts[kPosesNeeded] = static_cast<int64_t>(seen.poses);
  counts[kTasksNeeded] = static_cast<int64_t>(larger(seen.most_rest, left));
  counts[kLeafPairsNeeded] = static_cast<int64_t>(seen.leaves);
  counts[kCandidatesNeeded] = static_cast<int64_t>(seen.candidates.sum());
  counts[kTasksLeft] = static_cast<int64_t>(left);
  counts[kNodeTests] = static_cast<int64_t>(seen.node_tests);
  counts[kTraverseOverflow] = left != 0 || !capacity.holds(seen) || seen.unsound != 0 ? 1 : 0;
}

}  // namespace pgccd
