#include <algorithm>
#include <limits>
#include <tuple>

#include "core/enclosures.h"
#include "kernels/pipeline/one_pair.h"
#include "kernels/pipeline/search_order.h"
#include "kernels/traverse/leaf_feature_item.h"

namespace pgccd {

PairContact OnePairSearch::search(const RigidBodies& bodies, const OnePairQuery& query) {
  const bool is_any = query.report == Report::kAny;
  PairContact found = search_surfaces(bodies, query, is_any ? kFewAtStart : kAllLeaves);
  // Its descent may have ended early.
  if (is_any && !found.is_found() && leaves_.size() >= kFewAtStart) found = search_surfaces(bodies, query, kAllLeaves);
  if ((is_any && found.is_found()) || !query.tests_start) return found;
  const PairContact enclosed = search_enclosures(bodies, query);
  return enclosed.is_found() && (!found.is_found() || enclosed.is_before(found)) ? enclosed : found;
}

PairContact OnePairSearch::search_enclosures(const RigidBodies& bodies, const OnePairQuery& query) {
  candidates_.clear();
  if (bodies.meshes.solids.is_solid == nullptr) return {};
  for_each_enclosure(bodies, query.pair, 0, [&](const Candidate& c) { candidates_.push_back(c); });
  return solve(bodies, query, nullptr);
}

PairContact OnePairSearch::search_surfaces(const RigidBodies& bodies, const OnePairQuery& query, size_t most_at_start) {
  find_leaves(bodies, query, most_at_start);
  if (leaves_.empty()) return {};
  order(bodies, query);
  PairContact best;
  double latest = 1.0;
  for (size_t most = kFirstBatch; !wanted_.empty(); most *= 4) {
    const bool is_first = most == kFirstBatch;
    take_batch(most, is_first);
    if (latest < 1.0) place(bodies, query, latest);
    candidates_.clear();
    for (const LeafPair& leaves : batch_) list_candidates_of_leaves(placed_.tree(), leaves, is_first, candidates_);
    const PairContact found = solve(bodies, query, wants_first(query.report) ? &latest : nullptr);
    if (found.is_found() && (!best.is_found() || found.is_before(best))) best = found;
    if (!best.is_found()) continue;
    if (query.report == Report::kAny) break;
    latest = best.outcome.toi;
    // Of contacts at the same time, that of the smallest features is the first.
    const FirstFeature known =
        latest > 0.0 ? kNoFeature
                     : first_feature(static_cast<FeatureKind>(best.candidate.kind), best.candidate.feature_i);
    std::erase_if(wanted_, [&](const Wanted& w) { return w.leaves.begin > latest || w.first > known; });
  }
  return best;
}

double OnePairSearch::free_until(const RigidBodies& bodies, const OnePairQuery& query) {
  find_leaves(bodies, query, 1);
  double until = std::numeric_limits<double>::infinity();
  if (query.tests_start && search_enclosures(bodies, query).is_found()) return 0.0;
  for (const LeafPair& leaves : leaves_) until = smaller(until, double{leaves.begin});
  return until;
}

void OnePairSearch::place(const RigidBodies& bodies, const OnePairQuery& query, double until) {
  placed_.place(bodies, query.pair[0], query.pair[1], {query.separation, query.tolerance, query.tests_start, false},
                until);
}

void OnePairSearch::find_leaves(const RigidBodies& bodies, const OnePairQuery& query, size_t most_at_start) {
  leaves_.clear();
  place(bodies, query, 1.0);
  node_tests += find_leaves_of_pair(placed_.tree(), most_at_start, leaves_);
}

// Leaf pairs by time, and many also by feature.
void OnePairSearch::order(const RigidBodies& bodies, const OnePairQuery& query) {
  wanted_.clear();
  for (const LeafPair& leaves : leaves_) {
    const bool are_many = leaves_.size() > kFirstBatch;
    wanted_.push_back({leaves, are_many ? first_feature_of(bodies, query.pair, leaves.leaves) : 0});
  }
  std::sort(wanted_.begin(), wanted_.end(), [](const Wanted& a, const Wanted& b) {
    return std::tie(a.leaves.begin, a.first) < std::tie(b.leaves.begin, b.first);
  });
}

// Removes up to `most` leaf pairs; of those that may meet first only, if so wanted.
void OnePairSearch::take_batch(size_t most, bool only_first) {
  size_t count = std::min(most, wanted_.size());
  while (only_first && wanted_[count - 1].leaves.begin != wanted_[0].leaves.begin) --count;
  batch_.clear();
  for (size_t k = 0; k < count; ++k) batch_.push_back(wanted_[k].leaves);
  wanted_.erase(wanted_.begin(), wanted_.begin() + static_cast<std::ptrdiff_t>(count));
}

PairContact OnePairSearch::solve(const RigidBodies& bodies, const OnePairQuery& query, const double* latest) {
  candidates += static_cast<int64_t>(candidates_.size());
  if (candidates_.empty()) return {};
  NarrowInput input;
  input.candidates = {candidates_.data(), static_cast<int64_t>(candidates_.size())};
  input.pairs = query.pair;
  input.pair_count = 1;
  input.settings = {query.separation, query.tolerance, false};
  input.report = query.report;
  input.latest = latest;
  return contact_of_pair(bodies, input);
}

}  // namespace pgccd
