// A search of paths by a warp: its lanes share loops over bodies, pairs, node pairs, leaves and candidates.
#pragma once

#include <new>

#include "core/enclosures.h"
#include "kernels/arms/path_search_item.h"
#include "kernels/launch.cuh"
#include "kernels/narrow/candidate_item.h"
#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/support_item.h"

namespace pgccd {

// Node pairs of a descent that wait. Of more the search is given up.
constexpr int kWarpStack = 2048;
constexpr int kGroupsOfWarp = kWarp / kBlockWidth;

// Shared memory of a warp.
struct WarpShared {
  PairMemory pair;
  alignas(16) char sweep[sizeof(RigidSweep)];
  alignas(16) char both[sizeof(RigidPair)];
  LocalPose poses[kStoredSegments + 1];
  LeafPair leaves[kWarp];
};

class WarpTeam {
 public:
  static constexpr int kCount = kWarp;

  __device__ WarpTeam(WarpShared& shared, NodePair* stack)
      : shared_(shared), stack_(stack), lane_(static_cast<int>(threadIdx.x % kWarp)) {}

  __device__ int index() const { return lane_; }
  __device__ void sync() const { __syncwarp(); }
  __device__ bool any(bool value) const { return __any_sync(kAllLanes, value) != 0; }

  template <class Holds, class Use>
  __device__ __forceinline__ void for_each_where(int64_t count, Holds&& holds, Use&& use) const {
    for (int64_t base = 0; base < count; base += kWarp) {
      uint32_t lanes = __ballot_sync(kAllLanes, base + lane_ < count && holds(base + lane_));
      for (; lanes != 0; lanes &= lanes - 1) use(base + __ffs(static_cast<int>(lanes)) - 1);
    }
  }

  __device__ PairMemory& pair() { return shared_.pair; }

  __device__ void begin() {
    node_tests_ = candidates_ = 0;
    is_exhausted_ = false;
  }
  __device__ int64_t node_tests() const { return node_tests_; }
  __device__ int64_t candidates() const { return candidates_; }
  __device__ bool is_exhausted() const { return is_exhausted_; }
  __device__ void give_up() { is_exhausted_ = true; }

  __device__ bool is_known_apart(int64_t, const RigidBodies&) const { return false; }
  __device__ void learn(int64_t, const RigidBodies&) const {}

  // As OnePairSearch::free_until.
  __device__ __noinline__ double free_until(const RigidBodies& bodies, const PairQuery& query) {
    place(bodies, query);
    if (query.tests_start && search_enclosures(bodies, query).is_found()) return 0.0;
    const PairTree<RigidBodies> tree = tree_of(bodies);
    float least = kNeverMeet;
    descend(tree, [&](int count) {
      least = smaller(least, least_of_warp(begin_of(tree, count)));
      return least > 0.0f;
    });
    return least == kNeverMeet ? static_cast<double>(INFINITY) : static_cast<double>(least);
  }

  // As OnePairSearch::search.
  __device__ __noinline__ PairContact contact(const RigidBodies& bodies, const PairQuery& query) {
    place(bodies, query);
    const PairTree<RigidBodies> tree = tree_of(bodies);
    PairContact best;
    descend(tree, [&](int count) {
      float begin = begin_of(tree, count);
      for (;;) {
        // The leaves that may meet first: a contact of theirs makes that most others need not be visited.
        const float first = least_of_warp(begin);
        if (first == kNeverMeet || (best.is_found() && first > best.outcome.toi)) return true;
        const int lane = __ffs(static_cast<int>(__ballot_sync(kAllLanes, begin == first))) - 1;
        best = first_of(visit(bodies, tree, query, shared_.leaves[lane].leaves, first, best));
        if (query.any_will_do && best.is_found()) return false;
        if (lane_ == lane) begin = kNeverMeet;
      }
    });
    if (!query.tests_start || (query.any_will_do && best.is_found())) return best;
    const PairContact enclosed = search_enclosures(bodies, query);
    return enclosed.is_found() && (!best.is_found() || enclosed.is_before(best)) ? enclosed : best;
  }

 private:
  // Of numbers >= 0, whose bits have the same order.
  __device__ static float least_of_warp(float value) {
    return __uint_as_float(__reduce_min_sync(kAllLanes, __float_as_uint(value)));
  }

  __device__ const RigidPair& both() const { return *reinterpret_cast<const RigidPair*>(shared_.both); }
  __device__ const RigidSweep& sweep() const { return *reinterpret_cast<const RigidSweep*>(shared_.sweep); }
  __device__ PairTree<RigidBodies> tree_of(const RigidBodies& bodies) const { return {bodies, sweep(), shared_.poses}; }

  __device__ void place(const RigidBodies& bodies, const PairQuery& query) {
    __syncwarp();
    if (lane_ == 0) {
      new (shared_.sweep) RigidSweep(bodies, 0, 1, {0.0, query.tolerance, query.tests_start, false}, 1.0);
    } else if (lane_ == 1) {
      new (shared_.both) RigidPair(bodies, 0, 1);
    }
    __syncwarp();
    for (int k = lane_; k <= sweep().last_pose(); k += kWarp) shared_.poses[k] = sweep().pose(bodies, k);
    __syncwarp();
  }

  // Calls use(count) for up to a warp's number of pairs of leaves at a time, in `leaves`, while it returns true. Eight
  // lanes each split a node pair.
  template <class Use>
  __device__ __forceinline__ void descend(const PairTree<RigidBodies>& tree, Use&& use) {
    if (!child_may_meet<false>(tree, SplitPair{0, 0, 0}, 0)) return;
    const int group = lane_ / kBlockWidth, slot = lane_ % kBlockWidth;
    if (lane_ == 0) stack_[0] = {0, 0};
    __syncwarp();
    int found = 0;
    for (int size = 1; size > 0;) {
      const int taken = smaller(kGroupsOfWarp, size);
      NodePair nodes{0, 0}, child{0, 0};
      bool is_leaf = false, meets = false;
      if (group < taken) {
        nodes = stack_[size - 1 - group];
        is_leaf = tree.is_leaf_pair(nodes);
        if (!is_leaf) {
          const SplitPair split = tree.split(nodes);
          meets = child_may_meet<false>(tree, split, slot);
          child = split.child(slot);
        }
      }
      const uint32_t meeting = __ballot_sync(kAllLanes, meets);
      const uint32_t leaves = __ballot_sync(kAllLanes, is_leaf && slot == 0);
      size -= taken;
      if (size + __popc(meeting) > kWarpStack) {
        is_exhausted_ = true;
        return;
      }
      if (meets) stack_[size + __popc(meeting & lanes_below(lane_))] = child;
      if (is_leaf && slot == 0) shared_.leaves[found + __popc(leaves & lanes_below(lane_))] = {0, nodes, 0.0f};
      size += __popc(meeting);
      found += __popc(leaves);
      node_tests_ += kBlockWidth * (taken - __popc(leaves));
      __syncwarp();
      if (found > kWarp - kGroupsOfWarp || (size == 0 && found > 0)) {
        if (!use(found)) return;
        found = 0;
        __syncwarp();
      }
    }
  }

  // The time until which the lane's pair of leaves, one of `count`, stays apart.
  __device__ float begin_of(const PairTree<RigidBodies>& tree, int count) const {
    if (lane_ >= count) return kNeverMeet;
    const NodePair leaves = shared_.leaves[lane_].leaves;
    if (tree.link(0, leaves.first).triangle_count < 0 || tree.link(1, leaves.second).triangle_count < 0) {
      return kNeverMeet;
    }
    const Vec3<float> offset = tree.centre_at_start(1, leaves.second) - tree.centre_at_start(0, leaves.first);
    if (norm_squared(offset) < tree.sweep().inflation * tree.sweep().inflation) return 0.0f;
    return leaves_free_until<float>(tree, leaves);
  }

  // What the lane finds among its share of the candidates of two leaves, up to the contact that is known.
  __device__ __noinline__ PairContact visit(const RigidBodies& bodies, const PairTree<RigidBodies>& tree,
                                            const PairQuery& query, NodePair leaves, float begin,
                                            const PairContact& known) {
    const NodeLink first = tree.link(0, leaves.first), second = tree.link(1, leaves.second);
    const Triangle* const of_first = bodies.meshes.triangles + sweep().first_face[0] + first.first;
    const Triangle* const of_second = bodies.meshes.triangles + sweep().first_face[1] + second.first;
    const float distance = sweep().inflation, at_start = sweep().start_distance;
    const bool may_start_near = !(begin > 0.0f) && at_start >= 0.0f;
    PairContact best = known;
    const auto add = [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
      solve(bodies, query, {0, static_cast<int32_t>(kind), feature_i, feature_j}, best);
    };
    for (int both = lane_; both < first.triangle_count * second.triangle_count; both += kWarp) {
      const int p = both / second.triangle_count, q = both % second.triangle_count;
      const Triangle &i = of_first[p], &j = of_second[q];
      uint32_t wanted = represented_pairs(i, j);
      PGCCD_KEEP_LOOP
      for (int k = 1; k <= sweep().segment_count; ++k) {
        const MovingPoints<3, float> at_i = moving_triangles<float>(tree, 0, first.first + p, k);
        const MovingPoints<3, float> at_j = moving_triangles<float>(tree, 1, second.first + q, k);
        if (triangles_stay_apart(at_i, at_j, distance)) continue;
        if (k == 1 && may_start_near && !planes_separate(at_i.start, at_j.start, at_start, false) &&
            !edges_separate(at_i.start, at_j.start, at_start, false)) {
          const auto corner = [&](int side, int index) { return side == 0 ? at_i.start[index] : at_j.start[index]; };
          PGCCD_KEEP_LOOP
          for (uint32_t bits = represented_crossings(i, j, false); bits != 0; bits &= bits - 1) {
            const int bit = __ffs(static_cast<int>(bits)) - 1;
            if (!crossing_apart(corner, bit, at_start, false)) emit_crossing(i, j, bit, false, add);
          }
        }
        const auto corner = [&](int side, int index, int end) {
          const MovingPoints<3, float>& points = side == 0 ? at_i : at_j;
          return end == 0 ? points.start[index] : points.end[index];
        };
        PGCCD_KEEP_LOOP
        for (uint32_t bits = wanted; bits != 0; bits &= bits - 1) {
          const int bit = __ffs(static_cast<int>(bits)) - 1;
          const MovingFeatures<float> features = moving_features(corner, bit);
          if (features.plainly_apart(distance) || features.stepwise_apart(distance)) continue;
          wanted &= ~(1u << bit);
          emit_pair(i, j, bit, false, add);
        }
      }
    }
    return best;
  }

  // Bodies inside of solids: each lane solves its share of the candidates.
  __device__ __noinline__ PairContact search_enclosures(const RigidBodies& bodies, const PairQuery& query) {
    PairContact best;
    if (bodies.meshes.solids.is_solid == nullptr) return best;
    const int64_t pair[2] = {0, 1};
    int number = 0;
    for_each_enclosure(bodies, pair, 0, [&](const Candidate& candidate) {
      if (number++ % kWarp == lane_) solve(bodies, query, candidate, best);
    });
    return first_of(best);
  }

  __device__ __noinline__ void solve(const RigidBodies& bodies, const PairQuery& query, const Candidate& candidate,
                                     PairContact& best) {
    ++candidates_;
    const auto fine = [&] { return both().fine(bodies); };
    const double latest = best.is_found() ? (query.any_will_do ? -static_cast<double>(INFINITY) : best.outcome.toi)
                                          : (query.any_will_do ? static_cast<double>(INFINITY) : 1.0);
    const NarrowSettings settings{0.0, query.tolerance, false};
    PairContact found{candidate, is_of_start(candidate) ? solve_start(bodies, both(), fine, candidate)
                                                        : solve_candidate(bodies, both(), candidate, settings, latest)};
    const bool is_contact = found.outcome.status == Status::kTouch || found.outcome.status == Status::kUnresolved;
    if (is_contact && (!best.is_found() || found.is_before(best))) best = found;
  }

  // The first of the lanes' contacts.
  __device__ PairContact first_of(PairContact best) const {
    for (int away = kWarp / 2; away > 0; away /= 2) {
      PairContact other;
      other.outcome.toi = __shfl_xor_sync(kAllLanes, best.outcome.toi, away);
      other.outcome.status =
          static_cast<Status>(__shfl_xor_sync(kAllLanes, static_cast<int>(best.outcome.status), away));
      other.candidate.kind = __shfl_xor_sync(kAllLanes, best.candidate.kind, away);
      other.candidate.feature_i = __shfl_xor_sync(kAllLanes, best.candidate.feature_i, away);
      other.candidate.feature_j = __shfl_xor_sync(kAllLanes, best.candidate.feature_j, away);
      if (other.is_found() && (!best.is_found() || other.is_before(best))) best = other;
    }
    return best;
  }

  WarpShared& shared_;
  NodePair* stack_;
  int lane_;
  int64_t node_tests_ = 0, candidates_ = 0;
  bool is_exhausted_ = false;
};

}  // namespace pgccd
