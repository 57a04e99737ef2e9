// From pairs of leaves to candidates. A warp loads the triangles of two leaf pairs at a time. Triangle pairs, and then
// feature pairs, are collected in lists until all lanes have one: on average a leaf pair has nine and five.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/leaf_shared.cuh"
#include "kernels/traverse/time_spans.h"

namespace pgccd {

// A triangle over a segment, and whether it reaches into the other leaf's sphere.
struct TriangleReach {
  MovingPoints<3, float> moving;
  bool reaches;
};

template <class Bodies>
__device__ __forceinline__ TriangleReach reach_of(const PairTree<Bodies>& tree, NodePair leaves, int side, int row,
                                                  int k) {
  const int32_t own = side == 0 ? leaves.first : leaves.second, other = side == 0 ? leaves.second : leaves.first;
  const auto moving = moving_triangles<float>(tree, side, tree.link(side, own).first + row, k);
  const float reach = tree.local_radius(1 - side, other) + tree.sweep().inflation;
  return {moving, !stays_out(moving, tree.moving_centre(1 - side, other, k), reach)};
}

// The same of a pair that turns fast.
__device__ __noinline__ TriangleReach reach_while_turning(const PairTree<RigidBodies>& tree, NodePair leaves, int side,
                                                          int row, TimeSpan span) {
  return reach_of(SpanTree(tree, span).tree(), leaves, side, row, 1);
}
template <bool kDividesTime, class Bodies>
class LeafVisitor {
  using Sweep = SweepOf<Bodies>;

 public:
  __device__ LeafVisitor(const Pairs<Bodies>& pairs, LeafShared& shared, CandidateWriter& writer)
      : pairs_(pairs), shared_(shared), writer_(writer), lane_(threadIdx.x % kWarp) {}

  // `given`: two of them, one at the end of the list, or none after it: then all collected pairs are tested.
  __device__ __forceinline__ void visit(const LeafPair* given, int count) {
    const int half = lane_ / kHalf;
    const int side = lane_ % kHalf / kMaxLeafTriangles, row = lane_ % kMaxLeafTriangles;
    const bool has_pair = half < count;
    const LeafPair item = has_pair ? given[half] : LeafPair{};
    int own_segments = 0, triangle_count = 0;
    if (has_pair) {
      const PairTree<Bodies> tree = pairs_.tree(item.pair);
      own_segments = tree.sweep().segment_count;
      triangle_count = tree.link(side, side == 0 ? item.leaves.first : item.leaves.second).triangle_count;
    }
    const int segments = larger(__reduce_max_sync(kAllLanes, own_segments), 1);
    const bool remembers = segments > 1;
    if (remembers) {
      for (int k = lane_; k < 2 * kTrianglePairs; k += kWarp) shared_.met[k] = 0;
    }
    for (int k = 1; k <= segments; ++k) {
      const bool is_within = k <= own_segments && row < triangle_count;
      TriangleReach triangle{};
      bool is_turning = false;
      if constexpr (kDividesTime) {
        is_turning = own_segments > kStoredSegments;
        if (segments > kStoredSegments && (k - 1) % SpanWalk::kLongest == 0) {
          bool reaches = is_within;
          if (is_within && is_turning) {
            const TimeSpan span{k - 1, smaller(k - 1 + SpanWalk::kLongest, own_segments)};
            reaches = reach_while_turning(pairs_.tree(item.pair), item.leaves, side, row, span).reaches;
          }
          const uint32_t reaching = __ballot_sync(kAllLanes, reaches);
          if ((kept_of_half(reaching, 0) | kept_of_half(reaching, 1)) == 0) {
            k += SpanWalk::kLongest - 1;
            continue;
          }
        }
        if (is_within && is_turning) {
          triangle = reach_while_turning(pairs_.tree(item.pair), item.leaves, side, row, TimeSpan{k - 1, k});
        }
      }
      if (is_within && !is_turning) {
        triangle = reach_of(pairs_.tree(item.pair), item.leaves, side, row, k);
      }
      const uint32_t reaching = __ballot_sync(kAllLanes, triangle.reaches);
      const uint32_t kept = kept_of_half(reaching, 0) | kept_of_half(reaching, 1);
      // A single call of `work`, so that it is inlined and reads shared memory directly.
      for (bool stored = false; !stored;) {
        stored = filled_ + __popc(kept) <= kSlots;
        if (stored && kept != 0) {
          if (kept >> lane_ & 1u) store(item, side, row, triangle.moving, remembers, kept);
          queued_ += list_triangle_pairs(shared_, kept, filled_, queued_, lane_);
          filled_ += __popc(kept);
          __syncwarp();  // the triangles and their pairs are written
        }
        work(!stored || remembers || count == 0);
      }
    }
  }

 private:
  __device__ __forceinline__ void store(const LeafPair& item, int side, int row, const MovingPoints<3, float>& moving,
                                        bool remembers, uint32_t kept) {
    const PairTree<Bodies> tree = pairs_.tree(item.pair);
    const int32_t own = side == 0 ? item.leaves.first : item.leaves.second;
    const int slot = filled_ + __popc(kept & lanes_below(lane_));
    store_triangle(shared_, slot, moving);
    const int64_t triangle = tree.sweep().first_face[side] + tree.link(side, own).first + row;
    shared_.triangle[slot] = pairs_.bodies.meshes.triangles + triangle;
    shared_.distance[slot] = tree.sweep().inflation;
    shared_.pair[slot] = item.pair;
    shared_.lane[slot] = static_cast<uint8_t>(lane_);
    shared_.remembers[slot] = remembers;
    if constexpr (Sweep::may_be_one_body) {
      shared_.is_one_body[slot] = tree.sweep().is_one_body();
      shared_.is_one_leaf[slot] = tree.sweep().is_one_body() && item.leaves.first == item.leaves.second;
    }
  }

  // Tests full warps of collected pairs, or with `all` everything, which frees the slots.
  __device__ __forceinline__ void work(bool all) {
    for (;;) {
      if (near_ >= kWarp || (all && queued_ == 0 && waiting_ == 0 && near_ > 0)) {
        test_stepwise(smaller(near_, kWarp));
      } else if (waiting_ >= kWarp || (all && queued_ == 0 && waiting_ > 0)) {
        test_plainly(smaller(waiting_, kWarp));
      } else if (queued_ >= kWarp || (all && queued_ > 0)) {
        test_triangles(smaller(queued_, kWarp));
      } else {
        break;
      }
    }
    if (all) filled_ = 0;
  }

  // One waiting triangle pair per lane: lists the feature pairs it represents, unless the triangles stay apart.
  __device__ __forceinline__ void test_triangles(int count) {
    queued_ -= count;
    uint32_t wanted = 0;
    int code = 0;
    if (lane_ < count) {
      code = shared_.triangle_pairs[queued_ + lane_];
      const int i = code / kSlots, j = code % kSlots;
      const Triangle &first = *shared_.triangle[i], &second = *shared_.triangle[j];
      wanted = represented_pairs(first, second);
      if constexpr (Sweep::may_be_one_body) {
        if (shared_.is_one_body[i]) wanted &= pairs_without_common_vertex(first, second);
        if (shared_.is_one_leaf[i] && shared_.lane[j] % kMaxLeafTriangles <= shared_.lane[i] % kMaxLeafTriangles) {
          wanted = 0;
        }
      }
      if (shared_.remembers[i]) wanted &= ~static_cast<uint32_t>(shared_.met[met_place(shared_, i, j)]);
      if (wanted != 0 &&
          triangles_stay_apart(load_triangle(shared_, i), load_triangle(shared_, j), shared_.distance[i])) {
        wanted = 0;
      }
    }
    int added = 0;
    int at = waiting_ + sum_before(__popc(wanted), lane_, added);
    for (; wanted != 0; wanted &= wanted - 1) {
      shared_.features[at++] = static_cast<uint16_t>(code * 16 + __ffs(static_cast<int>(wanted)) - 1);
    }
    waiting_ += added;
    __syncwarp();  // the list is written
  }

  __device__ __forceinline__ MovingFeatures<float> features_of(int listed) const {
    const int i = listed / 16 / kSlots, j = listed / 16 % kSlots;
    const auto corner_of = [&](int side, int index, int end) { return corner(shared_, side == 0 ? i : j, index, end); };
    return moving_features(corner_of, listed % 16);
  }

  // One waiting feature pair per lane: lists those that `plainly_apart` does not reject.
  __device__ __forceinline__ void test_plainly(int count) {
    waiting_ -= count;
    const bool is_given = lane_ < count;
    const int listed = is_given ? shared_.features[waiting_ + lane_] : 0;
    const bool is_near = is_given && !features_of(listed).plainly_apart(shared_.distance[listed / 16 / kSlots]);
    const uint32_t lanes = __ballot_sync(kAllLanes, is_near);
    if (is_near) shared_.near[near_ + __popc(lanes & lanes_below(lane_))] = static_cast<uint16_t>(listed);
    near_ += __popc(lanes);
    __syncwarp();  // the list is written
  }

  // One near feature pair per lane: emits those that may meet.
  __device__ __forceinline__ void test_stepwise(int count) {
    near_ -= count;
    const bool is_given = lane_ < count;
    const int listed = is_given ? shared_.near[near_ + lane_] : 0;
    const int bit = listed % 16, i = listed / 16 / kSlots, j = listed / 16 % kSlots;
    const bool meets = is_given && !features_of(listed).stepwise_apart(shared_.distance[i]);
    Candidate candidate{};
    if (meets) {
      const bool is_one_body = Sweep::may_be_one_body && shared_.is_one_body[i];
      emit_pair(*shared_.triangle[i], *shared_.triangle[j], bit, is_one_body,
                [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
                  candidate = {shared_.pair[i], static_cast<int32_t>(kind), feature_i, feature_j};
                });
      if (shared_.remembers[i]) {  // other lanes may mark feature pairs of the same word
        const int place = met_place(shared_, i, j);
        atomicOr(reinterpret_cast<unsigned int*>(shared_.met) + place / 2, (1u << bit) << (16 * (place % 2)));
      }
    }
    writer_.add(meets, candidate, lane_);
    __syncwarp();  // the list has been read, and `met` is written
  }

  const Pairs<Bodies>& pairs_;
  LeafShared& shared_;
  CandidateWriter& writer_;
  const int lane_;
  int filled_ = 0;   // slots
  int queued_ = 0;   // triangle pairs waiting
  int waiting_ = 0;  // feature pairs waiting
  int near_ = 0;     // near feature pairs waiting
};

template <bool kDividesTime, class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    visit_leaves(Pairs<Bodies> pairs, LeafPairList leaves, CandidateSink out) {
  wait_for_previous_kernels();
  __shared__ LeafShared shared[kWarpsPerBlock];
  __shared__ CandidateBuffers buffers[kWarpsPerBlock];
  CandidateWriter writer(buffers[threadIdx.x / kWarp], out);
  LeafVisitor<kDividesTime, Bodies> visitor(pairs, shared[threadIdx.x / kWarp], writer);
  const uint32_t count = leaves.size(), warps = gridDim.x * kWarpsPerBlock;
  uint32_t item = 2 * ((blockIdx.x * blockDim.x + threadIdx.x) / kWarp);
  for (bool is_last = false; !is_last; item += 2 * warps) {
    is_last = item >= count;
    visitor.visit(leaves.items + item, is_last ? 0 : static_cast<int>(smaller(count - item, 2u)));
  }
  writer.flush(threadIdx.x % kWarp);
}

}  // namespace pgccd
