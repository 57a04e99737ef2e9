// The search of one body pair after another on the calling thread, in memory that is kept.
#pragma once

#include <vector>

#include "kernels/narrow/narrow.h"
#include "kernels/traverse/pair_descent.h"

namespace pgccd {

struct OnePairQuery {
  int64_t pair[2];
  double separation, tolerance;
  bool tests_start;
  Report report;  // kAny or kFirst
};

class OnePairSearch {
 public:
  // The contact to report of a pair that turns by little enough for few segments.
  PairContact search(const RigidBodies& bodies, const OnePairQuery& query);

  // The time, as part of the step, before which the pair certainly stays apart, as far as its leaves show; infinite for
  // the whole step. The candidates are not looked at.
  double free_until(const RigidBodies& bodies, const OnePairQuery& query);

  int64_t node_tests = 0, candidates = 0;  // of all searches

 private:
  struct Wanted {
    LeafPair leaves;
    FirstFeature first;  // of their candidates, at least
  };

  void find_leaves(const RigidBodies& bodies, const OnePairQuery& query, size_t most_at_start);
  PairContact search_surfaces(const RigidBodies& bodies, const OnePairQuery& query, size_t most_at_start);
  void place(const RigidBodies& bodies, const OnePairQuery& query, double until);
  void order(const RigidBodies& bodies, const OnePairQuery& query);
  void take_batch(size_t most, bool only_first);
  PairContact search_enclosures(const RigidBodies& bodies, const OnePairQuery& query);
  PairContact solve(const RigidBodies& bodies, const OnePairQuery& query, const double* latest);

  PlacedPair<RigidBodies> placed_;
  std::vector<LeafPair> leaves_, batch_;
  std::vector<Wanted> wanted_;
  std::vector<Candidate> candidates_;
};

}  // namespace pgccd
