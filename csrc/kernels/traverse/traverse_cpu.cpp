#include <bit>
#include <optional>

#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/support_item.h"
#include "kernels/traverse/traverse.h"

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
  using Sweep = SweepOf<Bodies>;

  PairCache(const Bodies& bodies, const TraverseInput& input) : bodies_(bodies), input_(input) {}

  PairTree<Bodies> tree(int32_t pair) {
    if (pair != current_) {
      current_ = pair;
      sweep_.emplace(bodies_, input_.pairs[2 * pair], input_.pairs[2 * pair + 1], input_.settings,
                     horizon_of(input_, pair));
      for (int k = 0; k <= sweep_->segment_count; ++k) poses_[k] = sweep_->pose(bodies_, k);
    }
    return {bodies_, *sweep_, poses_};
  }

 private:
  const Bodies& bodies_;
  const TraverseInput& input_;
  int32_t current_ = -1;
  std::optional<Sweep> sweep_;
  LocalPose poses_[kMaxSegments + 1]{};
};

template <class Visit>
void for_each_bit(uint32_t bits, Visit&& visit) {
  for (; bits != 0; bits &= bits - 1) visit(std::countr_zero(bits));
}

// Bit s is set if child s and the other node may meet during the step.
template <class Bodies>
uint32_t children_meeting(const PairTree<Bodies>& tree, const SplitPair& split) {
  uint32_t meeting = 0;
  for (int k = 1; k <= tree.sweep().segment_count; ++k) {
    const auto other = tree.other_node(split, k);
    // A branch-free loop over plain arrays, vectorised to eight lanes.
    float clearance[kBlockWidth];
    for (int slot = 0; slot < kBlockWidth; ++slot) clearance[slot] = tree.clearance(split, other, k, slot);
    uint32_t near = 0;
    for (int slot = 0; slot < kBlockWidth; ++slot) near |= may_meet(clearance[slot]) ? 1u << slot : 0u;
    near &= ~meeting;
    if (near != 0) near &= ~lane_bits(supports_separate<Float8>(tree, split, k, 0));
    meeting |= near;
  }
  return meeting;
}

MovingPoints<3, float> one_lane(const MovingPoints<3, Float8>& points, int lane) {
  MovingPoints<3, float> out;
  for (int c = 0; c < 3; ++c) {
    out.start[c] = {points.start[c].x[lane], points.start[c].y[lane], points.start[c].z[lane]};
    out.end[c] = {points.end[c].x[lane], points.end[c].y[lane], points.end[c].z[lane]};
  }
  return out;
}

template <int N>
MovingPoints<N, Float8> in_all_lanes(const MovingPoints<N, float>& points) {
  MovingPoints<N, Float8> out;
  for (int k = 0; k < N; ++k) {
    out.start[k] = broadcast(points.start[k]);
    out.end[k] = broadcast(points.end[k]);
  }
  return out;
}

Mask8 lanes_without(uint32_t bits) {
  const Mask8 bit{1, 2, 4, 8, 16, 32, 64, 128};
  return (bit & (static_cast<int32_t>(bits) - Mask8{})) == 0;
}

// Calls emit(lane, bit) for edges and faces of one triangle and others, the lanes `near`, that may pass through one
// another at t = 0.
template <class Bodies, class Emit>
void find_crossings(const PairTree<Bodies>& tree, const Triangle& one, const Triangle* others,
                    const Vec3<Float8> (&at_one)[3], const Vec3<Float8> (&at_others)[3], uint32_t near, Emit&& emit) {
  const float distance = tree.sweep().start_distance;
  const bool is_one_body = tree.sweep().is_one_body();
  // The planes of neighbouring triangles of one surface do not separate them.
  if (!is_one_body) {
    near &= ~lane_bits(planes_separate(at_one, at_others, distance, lanes_without(near)));
    if (near != 0) near &= ~lane_bits(edges_separate(at_one, at_others, distance, lanes_without(near)));
  }
  if (near == 0) return;
  const auto corner = [&](int side, int index) { return side == 0 ? at_one[index] : at_others[index]; };
  uint32_t lanes[kCrossingBits] = {};
  for_each_bit(near, [&](int lane) {
    for_each_bit(represented_crossings(one, others[lane], is_one_body), [&](int bit) { lanes[bit] |= 1u << lane; });
  });
  for (int bit = 0; bit < kCrossingBits; ++bit) {
    if (lanes[bit] == 0) continue;
    const Mask8 apart = crossing_apart(corner, bit, distance, lanes_without(lanes[bit]));
    for_each_bit(lanes[bit] & ~lane_bits(apart), [&](int lane) { emit(lane, bit); });
  }
}

// Triangles of a leaf, one bit each, that may reach into the other leaf's sphere over segment k.
template <class Bodies>
uint32_t triangles_reaching(const PairTree<Bodies>& tree, const MovingPoints<3, Float8>& triangles, int count, int side,
                            int32_t other_leaf, int k) {
  const float reach = tree.local_radius(1 - side, other_leaf) + tree.sweep().inflation;
  const MovingPoints<1, Float8> centre = in_all_lanes(tree.moving_centre(1 - side, other_leaf, k));
  return ((1u << count) - 1u) & ~lane_bits(stays_out(triangles, centre, reach));
}

// One triangle of the first leaf against all of the second's at a time. `begin`: the time until which the leaves
// certainly stay apart, or negative.
template <class Bodies, class Emit>
void visit_leaves(const PairTree<Bodies>& tree, NodePair leaves, float begin, Emit&& emit) {
  const NodeLink first = tree.link(0, leaves.first), second = tree.link(1, leaves.second);
  if (first.triangle_count < 0 || second.triangle_count < 0) return;
  const auto triangles = [&](int side) { return tree.bodies().meshes.triangles + tree.sweep().first_face[side]; };
  const Triangle *first_triangles = triangles(0) + first.first, *second_triangles = triangles(1) + second.first;
  const float distance = tree.sweep().inflation;
  const bool is_one_body = tree.sweep().is_one_body(), is_one_leaf = is_one_body && leaves.first == leaves.second;
  uint32_t meeting[kMaxLeafTriangles][kLanes] = {};
  bool is_near = false, may_start_near = false;
  for (int k = 1; k <= tree.sweep().segment_count; ++k) {
    const MovingPoints<3, Float8> i = moving_triangles<Float8>(tree, 0, first.first, k);
    const uint32_t reaching_i = triangles_reaching(tree, i, first.triangle_count, 0, leaves.second, k);
    if (reaching_i == 0) continue;
    const MovingPoints<3, Float8> j = moving_triangles<Float8>(tree, 1, second.first, k);
    const uint32_t reaching_j = triangles_reaching(tree, j, second.triangle_count, 1, leaves.first, k);
    if (reaching_j == 0) continue;
    // On a device this test comes first; on the host it is slower than the tests above.
    if (!is_near) {
      if (begin < 0.0f) begin = leaves_free_until<Float8>(tree, leaves);
      if (begin == kNeverMeet) return;
      may_start_near = !(begin > 0.0f) && tree.sweep().start_distance >= 0.0f;
    }
    is_near = true;
    for_each_bit(reaching_i, [&](int p) {
      const MovingPoints<3, float> one = one_lane(i, p);
      const MovingPoints<3, Float8> same = in_all_lanes(one);
      const uint32_t mirrored = is_one_leaf ? (2u << p) - 1u : 0u;
      const uint32_t near = reaching_j & ~lane_bits(triangles_stay_apart(same, j, distance)) & ~mirrored;
      if (k == 1 && may_start_near && near != 0) {
        find_crossings(tree, first_triangles[p], second_triangles, same.start, j.start, near, [&](int lane, int bit) {
          emit_crossing(first_triangles[p], second_triangles[lane], bit, is_one_body, emit);
        });
      }
      for_each_bit(near, [&](int lane) {
        const Triangle &first_triangle = first_triangles[p], &second_triangle = second_triangles[lane];
        uint32_t wanted = represented_pairs(first_triangle, second_triangle) & ~meeting[p][lane];
        if (is_one_body) wanted &= pairs_without_common_vertex(first_triangle, second_triangle);
        if (wanted == 0) return;
        const MovingPoints<3, float> other = one_lane(j, lane);
        const auto corner = [&](int side, int index, int end) {
          const MovingPoints<3, float>& points = side == 0 ? one : other;
          return end == 0 ? points.start[index] : points.end[index];
        };
        for_each_bit(wanted, [&](int bit) {
          const MovingFeatures features = moving_features(corner, bit);
          if (!features.plainly_apart(distance) && !features.stepwise_apart(distance)) meeting[p][lane] |= 1u << bit;
        });
      });
    });
  }
  for (int p = 0; p < first.triangle_count; ++p) {
    for (int lane = 0; lane < second.triangle_count; ++lane) {
      for_each_bit(meeting[p][lane],
                   [&](int bit) { emit_pair(first_triangles[p], second_triangles[lane], bit, is_one_body, emit); });
    }
  }
}

// The tasks of a body that is tested against itself. Returns the number of node tests.
template <class Bodies>
int64_t start_self_pairs(const PairTree<Bodies>& tree, int32_t pair, std::vector<Task>& tasks) {
  const int32_t blocks = tree.block_count();
  for (int32_t block = 0; block < blocks; ++block) {
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const SplitPair siblings = with_siblings(block, slot);
      if (tree.is_leaf(0, siblings.other())) tasks.push_back({pair, {siblings.other(), siblings.other()}});
      const uint32_t later = 0xffu << (slot + 1);
      for_each_bit(children_meeting(tree, siblings) & later,
                   [&](int other) { tasks.push_back({pair, siblings.child(other)}); });
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
      tasks.push_back({row, {0, 0}});
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
      for_each_bit(children_meeting(tree, split), [&](int slot) { next.push_back({task.pair, split.child(slot)}); });
    }
    tasks.swap(next);
  }
  return tasks;
}

// The time until which the leaves certainly stay apart. On the host the tests of all triangles against the other leaf's
// sphere come first: they reject most pairs, faster.
template <class Bodies>
float begin_of(const PairTree<Bodies>& tree, NodePair leaves) {
  const NodeLink first = tree.link(0, leaves.first), second = tree.link(1, leaves.second);
  if (first.triangle_count < 0 || second.triangle_count < 0) return kNeverMeet;
  const auto reach = [&](int side, const NodeLink& leaf, int32_t other, int k) {
    const MovingPoints<3, Float8> triangles = moving_triangles<Float8>(tree, side, leaf.first, k);
    return triangles_reaching(tree, triangles, leaf.triangle_count, side, other, k) != 0;
  };
  // Leaves this near may meet from the start: the time only decides what is searched first.
  const Vec3<float> offset = tree.centre_at_start(1, leaves.second) - tree.centre_at_start(0, leaves.first);
  if (norm_squared(offset) < tree.sweep().inflation * tree.sweep().inflation) return 0.0f;
  for (int k = 1; k <= tree.sweep().segment_count; ++k) {
    if (reach(0, first, leaves.second, k) && reach(1, second, leaves.first, k)) {
      return leaves_free_until<Float8>(tree, leaves);
    }
  }
  return kNeverMeet;
}

// Calls use(leaves) for pairs of leaves, while that returns true; returns the number of node tests.
template <class Bodies, class Use>
int64_t descend(const PairTree<Bodies>& tree, NodePair start, Use&& use) {
  if (start.first == 0 && start.second == 0 && !roots_may_meet(tree)) return 0;
  int64_t tests = 0;
  // A split takes one entry and adds at most eight, and no path splits more often than both trees are deep.
  NodePair stack[2 * kMaxTreeDepth * (kBlockWidth - 1) + 1];
  int size = 0;
  stack[size++] = start;
  while (size > 0) {
    const NodePair nodes = stack[--size];
    if (tree.is_leaf_pair(nodes)) {
      if (!use(nodes)) break;
      continue;
    }
    const SplitPair split = tree.split(nodes);
    tests += kBlockWidth;
    for_each_bit(children_meeting(tree, split), [&](int slot) { stack[size++] = split.child(slot); });
  }
  return tests;
}

// Appends the candidates of a pair of leaves.
template <class Bodies>
void append_candidates(const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, float begin,
                       std::vector<Candidate>& out) {
  visit_leaves(tree, leaves, begin, [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
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

// Calls use(tree, pair, leaves, rows, count) for the pairs of leaves that the descent of all pairs reaches. A task's
// descent ends when it returns false; `count` is 0 at the start of each task.
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
        size_t of_task = 0;
        const auto use_leaves = [&](NodePair leaves) { return use(tree, task.pair, leaves, rows, of_task); };
        tests.fetch_add(descend(tree, task.nodes, use_leaves), std::memory_order_relaxed);
      });
  node_tests = tests;
  return parts;
}

}  // namespace

template <class Bodies>
CandidateList list_candidates(const Executor& executor, const Bodies& bodies, const TraverseInput& input) {
  CandidateList list;
  const auto append = [](const PairTree<Bodies>& tree, int32_t pair, NodePair leaves, std::vector<Candidate>& out,
                         size_t&) {
    append_candidates(tree, pair, leaves, kUnknownBegin, out);
    return true;
  };
  list.parts = descend_all<Candidate>(executor, bodies, input, list.node_tests, append);
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

template <class Bodies>
FoundLeaves find_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                            size_t most_at_start) {
  FoundLeaves found;
  const auto list_if_meeting = [most_at_start](const PairTree<Bodies>& tree, int32_t pair, NodePair leaves,
                                               std::vector<LeafPair>& out, size_t& at_start) {
    // Folded surfaces have many leaf pairs that may meet from the start: parts save nothing.
    const float begin = tree.sweep().is_one_body() ? kUnknownBegin : begin_of(tree, leaves);
    if (begin != kNeverMeet) out.push_back({pair, leaves, begin});
    if (!(begin > 0.0f)) ++at_start;
    return at_start < most_at_start;
  };
  for (const auto& part : descend_all<LeafPair>(executor, bodies, input, found.node_tests, list_if_meeting)) {
    found.pairs.insert(found.pairs.end(), part.begin(), part.end());
  }
  return found;
}

template <class Bodies>
CandidateList visit_leaf_pairs(const Executor& executor, const Bodies& bodies, const TraverseInput& input,
                               const std::vector<LeafPair>& leaves) {
  CandidateList list;
  list.parts =
      for_each_of_pairs<Candidate>(executor, bodies, input, leaves,
                                   [](const PairTree<Bodies>& tree, const LeafPair& item, std::vector<Candidate>& out) {
                                     append_candidates(tree, item.pair, item.leaves, item.begin, out);
                                   });
  return list;
}

template void traverse(const Executor&, const RigidBodies&, const TraverseInput&, const CandidateOutput&, int64_t*);
template void traverse(const Executor&, const DeformingBodies&, const TraverseInput&, const CandidateOutput&, int64_t*);
template CandidateList list_candidates(const Executor&, const RigidBodies&, const TraverseInput&);
template CandidateList list_candidates(const Executor&, const DeformingBodies&, const TraverseInput&);
template FoundLeaves find_leaf_pairs(const Executor&, const RigidBodies&, const TraverseInput&, size_t);
template FoundLeaves find_leaf_pairs(const Executor&, const DeformingBodies&, const TraverseInput&, size_t);
template CandidateList visit_leaf_pairs(const Executor&, const RigidBodies&, const TraverseInput&,
                                        const std::vector<LeafPair>&);
template CandidateList visit_leaf_pairs(const Executor&, const DeformingBodies&, const TraverseInput&,
                                        const std::vector<LeafPair>&);

}  // namespace pgccd
