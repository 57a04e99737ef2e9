// A search of paths on one thread of the host.
#pragma once

#include "kernels/arms/path_search_item.h"
#include "kernels/pipeline/one_pair.h"

namespace pgccd {

class HostTeam {
 public:
  static constexpr int kCount = 1;
  int index() const { return 0; }
  void sync() const {}
  bool any(bool value) const { return value; }

  template <class Holds, class Use>
  void for_each_where(int64_t count, Holds&& holds, Use&& use) const {
    for (int64_t k = 0; k < count; ++k) {
      if (holds(k)) use(k);
    }
  }

  PairMemory& pair() { return pair_; }
  double free_until(const RigidBodies& bodies, const PairQuery& query) {
    return search_.free_until(bodies, one_pair(query));
  }
  PairContact contact(const RigidBodies& bodies, const PairQuery& query) {
    return search_.search(bodies, one_pair(query));
  }

  void begin() {
    search_.node_tests = search_.candidates = 0;
    is_exhausted_ = false;
  }
  int64_t node_tests() const { return search_.node_tests; }
  int64_t candidates() const { return search_.candidates; }
  bool is_exhausted() const { return is_exhausted_; }
  void give_up() { is_exhausted_ = true; }

  // Nothing is kept between paths.
  bool is_known_apart(int64_t, const RigidBodies&) const { return false; }
  void learn(int64_t, const RigidBodies&) const {}

 private:
  static OnePairQuery one_pair(const PairQuery& query) {
    return {{0, 1}, 0.0, query.tolerance, query.tests_start, query.any_will_do ? Report::kAny : Report::kFirst};
  }

  OnePairSearch search_;
  PairMemory pair_;
  bool is_exhausted_ = false;
};

}  // namespace pgccd
