#include "kernels/traverse/pair_item.h"
#include "kernels/traverse/traverse.h"

#include <bit>

namespace pgccd {
namespace {

constexpr int64_t kTaskGrain = 8;

struct Task {
  int32_t pair;
  NodePair nodes;
};

// The current pair's sweep and poses; consecutive tasks mostly share them.
template <class Bodies>
class PairCache {
 public:
  using Sweep = typename SweepOf<Bodies>::type;

  PairCache(const Bodies& bodies, const int64_t* pairs, double separation)
      : bodies_(bodies), pairs_(pairs), separation_(separation), sweep_(bodies, pairs[0], pairs[1], separation) {}

  PairTree<Bodies> tree(int32_t pair) {
    if (pair != current_) {
      current_ = pair;
      sweep_ = Sweep(bodies_, pairs_[2 * int64_t(pair)], pairs_[2 * int64_t(pair) + 1], separation_);
      for (int k = 0; k <= sweep_.segment_count; ++k) poses_[k] = sweep_.pose(bodies_, k);
    }
    return {bodies_, sweep_, poses_};
  }

 private:
  const Bodies& bodies_;
  const int64_t* pairs_;
  double separation_;
  int32_t current_ = -1;
  Sweep sweep_;
  LocalPose poses_[kMaxSegments + 1]{};
};

// A few large pairs are cut into many tasks, level by level, so that every worker has some; order is kept.
template <class Bodies>
std::vector<Task> make_tasks(const Bodies& bodies, const int64_t* pairs, int64_t pair_count, double separation,
                             int workers, int64_t& node_tests) {
  std::vector<Task> tasks;
  tasks.reserve(pair_count);
  for (int64_t pair = 0; pair < pair_count; ++pair) tasks.push_back({static_cast<int32_t>(pair), {0, 0}});
  const size_t enough = static_cast<size_t>(workers > 1 ? 16 * workers : 0);
  PairCache<Bodies> cache(bodies, pairs, separation);
  for (int level = 0; level < 2 * kMaxTreeDepth && !tasks.empty() && tasks.size() < enough; ++level) {
    std::vector<Task> next;
    for (const Task& task : tasks) {
      const PairTree<Bodies> tree = cache.tree(task.pair);
      if (tree.is_leaf_pair(task.nodes)) {
        next.push_back(task);
        continue;
      }
      const SplitPair split = tree.split(task.nodes);
      node_tests += kBlockWidth;
      for (int slot = 0; slot < kBlockWidth; ++slot) {
        if (split.mask & (1u << slot)) next.push_back({task.pair, split.child(slot)});
      }
    }
    tasks.swap(next);
  }
  return tasks;
}

template <class Bodies>
int64_t descend(const PairTree<Bodies>& tree, const Task& task, std::vector<Candidate>& out) {
  const auto emit = [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
    out.push_back({task.pair, static_cast<int32_t>(kind), feature_i, feature_j});
  };
  int64_t tests = 0;
  // A split takes one entry and adds at most eight, and no path splits more often than both trees are deep.
  NodePair stack[2 * kMaxTreeDepth * (kBlockWidth - 1) + 1];
  int size = 0;
  stack[size++] = task.nodes;
  while (size > 0) {
    const NodePair nodes = stack[--size];
    if (tree.is_leaf_pair(nodes)) {
      tree.leaf_candidates(nodes, emit);
      continue;
    }
    const SplitPair split = tree.split(nodes);
    tests += kBlockWidth;
    for (uint32_t left = split.mask; left != 0; left &= left - 1) stack[size++] = split.child(std::countr_zero(left));
  }
  return tests;
}

}  // namespace

template <class Bodies>
CandidateList traverse_cpu(const Executor& executor, const Bodies& bodies, const int64_t* pairs, int64_t pair_count,
                           double separation) {
  CandidateList list;
  if (pair_count == 0) return list;
  const std::vector<Task> tasks =
      make_tasks(bodies, pairs, pair_count, separation, executor.worker_count(), list.node_tests);
  const int64_t count = static_cast<int64_t>(tasks.size());
  list.parts.resize((count + kTaskGrain - 1) / kTaskGrain);
  std::atomic<int64_t> node_tests{list.node_tests};
  parallel_chunks(executor, count, kTaskGrain, [&](int, int64_t begin, int64_t end) {
    PairCache<Bodies> cache(bodies, pairs, separation);
    int64_t tests = 0;
    for (int64_t k = begin; k < end; ++k)
      tests += descend(cache.tree(tasks[k].pair), tasks[k], list.parts[begin / kTaskGrain]);
    node_tests.fetch_add(tests, std::memory_order_relaxed);
  });
  list.node_tests = node_tests;
  return list;
}

template CandidateList traverse_cpu(const Executor&, const RigidBodies&, const int64_t*, int64_t, double);
template CandidateList traverse_cpu(const Executor&, const DeformingBodies&, const int64_t*, int64_t, double);

}  // namespace pgccd
