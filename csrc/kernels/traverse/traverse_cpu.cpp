// Loops over lanes are only vectorised if what they call is inlined: see core/platform.h.
#define PGCCD_INLINE_ALL

#include "core/enclosures.h"
#include "kernels/traverse/pair_descent.h"
#include "kernels/traverse/support_item.h"
#include "kernels/traverse/traverse.h"
#include "kernels/traverse/visit_leaves_host.h"

namespace pgccd {
namespace {

constexpr int64_t kTaskGrain = 8;
constexpr int64_t kPairGrain = 256;

struct Task {
  int32_t pair;
  NodePair nodes;
  Windows windows;
};

// The current pair's sweep and poses; consecutive tasks mostly share them.
template <class Bodies>
class PairCache {
 public:
  PairCache(const Bodies& bodies, const TraverseInput& input) : bodies_(bodies), input_(input) {}

  PairTree<Bodies> tree(int32_t pair) {
    if (pair != current_) {
      current_ = pair;
      placed_.place(bodies_, input_.pairs[2 * pair], input_.pairs[2 * pair + 1], input_.settings,
                    horizon_of(input_, pair));
    }
    return placed_.tree();
  }

 private:
  const Bodies& bodies_;
  const TraverseInput& input_;
  int32_t current_ = -1;
  PlacedPair<Bodies> placed_;
};

// Bit s is set if child s, one of `wanted`, and the other node may meet over segment k.
template <class Bodies>
uint32_t children_meeting(const PairTree<Bodies>& tree, const SplitPair& split, int k, uint32_t wanted) {
  const auto other = tree.other_node(split, k);
  // A branch-free loop over plain arrays, vectorised to eight lanes.
  float clearance[kBlockWidth];
  for (int slot = 0; slot < kBlockWidth; ++slot) clearance[slot] = tree.clearance(split, other, k, slot);
  uint32_t near = 0;
  for (int slot = 0; slot < kBlockWidth; ++slot) near |= may_meet(clearance[slot]) ? 1u << slot : 0u;
  near &= wanted;
  if (near != 0) near &= ~lane_bits(supports_separate<Float8>(tree, split, k, 0));
  return near;
}

// Calls use(slot, windows) for each child of a split that may meet the other node during the step, or in `windows` of
// it if the pair turns fast.
template <class Bodies, class Use>
void for_each_meeting(const PairTree<Bodies>& tree, const SplitPair& split, Windows windows, Use&& use) {
  if (!tree.sweep().turns_fast()) {
    uint32_t meeting = 0;
    for (int k = 1; k <= tree.sweep().segment_count; ++k) meeting |= children_meeting(tree, split, k, ~meeting);
    for_each_bit(meeting, [&](int slot) { use(slot, windows); });
    return;
  }
  Windows meeting[kBlockWidth] = {};
  for_each_window(tree, windows, [&](int window, TimeSpan range) {
    uint32_t open = (1u << kBlockWidth) - 1u;
    walk_spans(tree, range, [&](const PairTree<Bodies>& over, TimeSpan span) {
      const uint32_t near = children_meeting(over, split, 1, open);
      if (span.length() > 1) return near == 0 ? Then::kNext : Then::kDivide;
      for_each_bit(near, [&](int slot) { meeting[slot] |= Windows{1} << window; });
      open &= ~near;
      return open == 0 ? Then::kStop : Then::kNext;
    });
  });
  for (int slot = 0; slot < kBlockWidth; ++slot) {
    if (meeting[slot] != 0) use(slot, meeting[slot]);
  }
}

// The tasks of a body that is tested against itself. Returns the number of node tests.
template <class Bodies>
int64_t start_self_pairs(const PairTree<Bodies>& tree, int32_t pair, std::vector<Task>& tasks) {
  const int32_t blocks = tree.block_count();
  for (int32_t block = 0; block < blocks; ++block) {
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const SplitPair siblings = with_siblings(block, slot);
      if (tree.is_leaf(0, siblings.other())) tasks.push_back({pair, {siblings.other(), siblings.other()}, kAllWindows});
      for_each_meeting(tree, siblings, kAllWindows, [&](int other, Windows windows) {
        if (other > slot) tasks.push_back({pair, siblings.child(other), windows});
      });
    }
  }
  return int64_t{kPairsInBlock} * blocks;
}

// Splits a few large pairs into many tasks, level by level, so that every worker has some; order is kept.
template <class Bodies>
std::vector<Task> make_tasks(const Bodies& bodies, const TraverseInput& input, int workers, int64_t& node_tests) {
  std::vector<Task> tasks;
  tasks.reserve(input.pair_count);
  PairCache<Bodies> cache(bodies, input);
  for (int64_t pair = 0; pair < input.pair_count; ++pair) {
    const int32_t row = static_cast<int32_t>(pair);
    if (!SweepOf<Bodies>::may_be_one_body || input.pairs[2 * pair] != input.pairs[2 * pair + 1]) {
      tasks.push_back({row, {0, 0}, kAllWindows});
    } else {
      node_tests += start_self_pairs(cache.tree(row), row, tasks);
    }
  }
  const size_t enough = static_cast<size_t>(workers > 1 ? 16 * workers : 0);
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
      for_each_meeting(tree, split, task.windows,
                       [&](int slot, Windows windows) { next.push_back({task.pair, split.child(slot), windows}); });
    }
    tasks.swap(next);
  }
  return tasks;
}

// Calls use(leaves, windows) for pairs of leaves, while that returns true; returns the number of node tests.
template <class Bodies, class Use>
int64_t descend(const PairTree<Bodies>& tree, NodePair start, Windows windows, Use&& use) {
  // A split takes one entry and adds at most eight, and no path splits more often than both trees are deep.
  struct Entry {
    NodePair nodes;
    Windows windows;
  } stack[2 * kMaxTreeDepth * (kBlockWidth - 1) + 1];
  int size = 0;
  if (start.first != 0 || start.second != 0) {
    stack[size++] = {start, windows};
  } else if (tree.sweep().turns_fast()) {
    for_each_meeting(tree, {0, 0, 0}, windows, [&](int, Windows meeting) { stack[size++] = {start, meeting}; });
  } else if (roots_may_meet<false>(tree)) {
    stack[size++] = {start, windows};
  }
  int64_t tests = 0;
  while (size > 0) {
    const Entry entry = stack[--size];
    if (tree.is_leaf_pair(entry.nodes)) {
      if (!use(entry.nodes, entry.windows)) break;
      continue;
    }
    const SplitPair split = tree.split(entry.nodes);
    tests += kBlockWidth;
    for_each_meeting(tree, split, entry.windows,
                     [&](int slot, Windows meeting) { stack[size++] = {split.child(slot), meeting}; });
  }
  return tests;
}

// Appends the candidates of a pair of leaves.
template <class Bodies>
void append_candidates(const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, Windows windows, float begin,
                       std::vector<Candidate>& out) {
  visit_leaves(tree, leaves, windows, begin, [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
    out.push_back({pair, static_cast<int32_t>(kind), feature_i, feature_j});
  });
}

// Rows found by workers: the parts, one after the other, are in the order of the items.
template <class Row>
using Parts = std::vector<std::vector<Row>>;

// Calls use(tree, item, rows) for items of body pairs, such as tasks.
template <class Row, class Bodies, class Item, class Use>
Parts<Row> for_each_of_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                             const std::vector<Item>& items, Use&& use) {
  const int64_t count = static_cast<int64_t>(items.size());
  Parts<Row> parts((count + kTaskGrain - 1) / kTaskGrain);
  parallel_chunks(executor, count, kTaskGrain, [&](int, int64_t begin, int64_t end) {
    PairCache<Bodies> cache(bodies, input);
    for (int64_t k = begin; k < end; ++k) use(cache.tree(items[k].pair), items[k], parts[begin / kTaskGrain]);
  });
  return parts;
}

// Calls use(tree, pair, leaves, windows, rows, count) for the pairs of leaves that the descent of all pairs reaches. A
// task's descent ends when it returns false; `count` is 0 at the start of each task.
template <class Row, class Bodies, class Use>
Parts<Row> descend_all(const Executor& executor, const Bodies& bodies, const TraverseInput& input, int64_t& node_tests,
                       Use&& use) {
  if (input.pair_count == 0) return {};
  const auto both = [&](int64_t pair, const auto& is_so) {
    return is_so(input.pairs[2 * pair]) && is_so(input.pairs[2 * pair + 1]);
  };
  require_rows(executor, input.pair_count, "pairs", "name bodies that are there", [&](int64_t pair) {
    return both(pair, [&](int64_t body) { return is_within(body, bodies.centres.count); });
  });
  require_rows(executor, input.pair_count, "pairs", "name bodies of which meshes, vertices and node blocks are there",
               [&](int64_t pair) { return both(pair, [&](int64_t body) { return is_sound(bodies, body); }); });
  const std::vector<Task> tasks = make_tasks(bodies, input, executor.worker_count(), node_tests);
  std::atomic<int64_t> tests{node_tests};
  Parts<Row> parts = for_each_of_pairs<Row>(
      executor, bodies, input, tasks, [&](const PairTree<Bodies>& tree, const Task& task, std::vector<Row>& rows) {
        size_t count = 0;
        const auto use_leaves = [&](NodePair leaves, Windows windows) {
          return use(tree, task.pair, leaves, windows, rows, count);
        };
        tests.fetch_add(descend(tree, task.nodes, task.windows, use_leaves), std::memory_order_relaxed);
      });
  node_tests = tests;
  return parts;
}

}  // namespace

template <class Bodies>
CandidateList list_candidates(const Executor& executor, const Bodies& bodies, const TraverseInput& input) {
  CandidateList list;
  const auto append = [](const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, Windows windows,
                         std::vector<Candidate>& out, size_t&) {
    append_candidates(tree, pair, leaves, windows, kUnknownBegin, out);
    return true;
  };
  list.parts = descend_all<Candidate>(executor, bodies, input, list.node_tests, append);
  for (auto& part : list_enclosures(executor, bodies, input).parts) list.parts.push_back(std::move(part));
  return list;
}

template <class Bodies>
CandidateList list_enclosures(const Executor& executor, const Bodies& bodies, const TraverseInput& input) {
  CandidateList list;
  if (bodies.meshes.solids.is_solid == nullptr || !input.settings.tests_start) return list;
  list.parts.resize((input.pair_count + kPairGrain - 1) / kPairGrain);
  parallel_chunks(executor, input.pair_count, kPairGrain, [&](int, int64_t begin, int64_t end) {
    auto& part = list.parts[begin / kPairGrain];
    for (int64_t pair = begin; pair < end; ++pair) {
      for_each_enclosure(bodies, input.pairs, pair, [&](const Candidate& c) { part.push_back(c); });
    }
  });
  return list;
}

template <class Bodies>
void traverse(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
              const CandidateOutput& make_output, int64_t* node_tests) {
  const CandidateList list = list_candidates(executor, bodies, input);
  Candidate* out = make_output(list.size());
  for (const auto& part : list.parts) out = std::copy(part.begin(), part.end(), out);
  *node_tests = list.node_tests;
}

namespace {

// Lists a pair of leaves if they may meet; returns whether the descent goes on.
template <class Bodies>
bool list_if_meeting(const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, Windows windows, size_t most_at_start,
                     std::vector<LeafPair>& out, size_t& at_start) {
  // Folded surfaces have many leaf pairs that may meet from the start: parts save nothing.
  const float begin = tree.sweep().is_one_body() ? 0.0f : begin_of(tree, leaves, windows);
  if (begin != kNeverMeet) out.push_back({pair, leaves, begin});
  if (begin == 0.0f) ++at_start;
  return at_start < most_at_start;
}

template <class Bodies>
void append_candidates_from(const PairTree<Bodies>& tree, const LeafPair& item, bool over_same_time,
                            std::vector<Candidate>& out) {
  const float begin = over_same_time && !tree.sweep().is_one_body() ? item.begin : kUnknownBegin;
  append_candidates(tree, item.pair, item.leaves, windows_from(tree, item.begin), begin, out);
}

}  // namespace

template <class Bodies>
int64_t find_leaves_of_pair(const PairTree<Bodies>& tree, size_t most_at_start, std::vector<LeafPair>& out) {
  size_t at_start = 0;
  return descend(tree, {0, 0}, kAllWindows, [&](NodePair leaves, Windows windows) {
    return list_if_meeting(tree, 0, leaves, windows, most_at_start, out, at_start);
  });
}

template <class Bodies>
void list_candidates_of_leaves(const PairTree<Bodies>& tree, const LeafPair& leaves, bool over_same_time,
                               std::vector<Candidate>& out) {
  append_candidates_from(tree, leaves, over_same_time, out);
}

template <class Bodies>
FoundLeaves find_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                            size_t most_at_start) {
  FoundLeaves found;
  const auto list = [&](const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, Windows windows,
                        std::vector<LeafPair>& out, size_t& at_start) {
    return list_if_meeting(tree, pair, leaves, windows, most_at_start, out, at_start);
  };
  for (const auto& part : descend_all<LeafPair>(executor, bodies, input, found.node_tests, list)) {
    found.pairs.insert(found.pairs.end(), part.begin(), part.end());
  }
  return found;
}

template <class Bodies>
CandidateList visit_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                               const std::vector<LeafPair>& leaves, bool over_same_time) {
  CandidateList list;
  const auto append = [&](const PairTree<Bodies>& tree, const LeafPair& item, std::vector<Candidate>& out) {
    append_candidates_from(tree, item, over_same_time, out);
  };
  list.parts = for_each_of_pairs<Candidate>(executor, bodies, input, leaves, append);
  return list;
}

template int64_t find_leaves_of_pair(const PairTree<RigidBodies>&, size_t, std::vector<LeafPair>&);
template void list_candidates_of_leaves(const PairTree<RigidBodies>&, const LeafPair&, bool, std::vector<Candidate>&);
template void traverse(const Executor&, const RigidBodies&, const TraverseInput&, const CandidateOutput&, int64_t*);
template void traverse(const Executor&, const DeformingBodies&, const TraverseInput&, const CandidateOutput&, int64_t*);
template CandidateList list_enclosures(const Executor&, const RigidBodies&, const TraverseInput&);
template CandidateList list_enclosures(const Executor&, const DeformingBodies&, const TraverseInput&);
template CandidateList list_candidates(const Executor&, const RigidBodies&, const TraverseInput&);
template CandidateList list_candidates(const Executor&, const DeformingBodies&, const TraverseInput&);
template FoundLeaves find_leaf_pairs(const Executor&, const RigidBodies&, const TraverseInput&, size_t);
template FoundLeaves find_leaf_pairs(const Executor&, const DeformingBodies&, const TraverseInput&, size_t);
template CandidateList visit_leaf_pairs(const Executor&, const RigidBodies&, const TraverseInput&,
                                        const std::vector<LeafPair>&, bool);
template CandidateList visit_leaf_pairs(const Executor&, const DeformingBodies&, const TraverseInput&,
                                        const std::vector<LeafPair>&, bool);

}  // namespace pgccd
