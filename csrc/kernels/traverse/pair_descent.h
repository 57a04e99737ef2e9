// The traversal of one body pair after another on the calling thread of the host.
#pragma once

#include <optional>
#include <vector>

#include "kernels/traverse/traverse.h"

namespace pgccd {

// A pair in its local frame, and its poses at the boundaries of segments.
template <class Bodies>
class PlacedPair {
 public:
  void place(const Bodies& bodies, int64_t i, int64_t j, const SweepSettings& settings, double until) {
    bodies_ = &bodies;
    sweep_.emplace(bodies, i, j, settings, until);
    for (int k = 0; k <= sweep_->last_pose(); ++k) poses_[k] = sweep_->pose(bodies, k);
  }

  PairTree<Bodies> tree() const { return {*bodies_, *sweep_, poses_}; }

 private:
  const Bodies* bodies_ = nullptr;
  std::optional<SweepOf<Bodies>> sweep_;
  LocalPose poses_[kStoredSegments + 1];
};

// Appends the pairs of leaves that may meet, as `find_leaf_pairs`, with 0 for their body pair; returns the number of
// node tests.
template <class Bodies>
int64_t find_leaves_of_pair(const PairTree<Bodies>& tree, size_t most_at_start, std::vector<LeafPair>& out);

// Appends the candidates of a pair of leaves, as `visit_leaf_pairs`.
template <class Bodies>
void list_candidates_of_leaves(const PairTree<Bodies>& tree, const LeafPair& leaves, bool over_same_time,
                               std::vector<Candidate>& out);

}  // namespace pgccd
