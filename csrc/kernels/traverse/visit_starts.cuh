// From pairs of leaves that may be near at t = 0 to edges and faces that may pass through one another there. A warp
// takes four leaf pairs at a time, and lists their triangle pairs: few of them pass a test, so that the next one would
// otherwise run with few lanes.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/leaf_shared.cuh"
#include "kernels/warp_share.cuh"

namespace pgccd {

constexpr int kLeafPairsOfWarp = kWarp / kMaxLeafTriangles;
constexpr int kTrianglesOfLeafPair = 2 * kMaxLeafTriangles;
constexpr int kStartSlots = kLeafPairsOfWarp * kTrianglesOfLeafPair;
static_assert(kStartSlots * kStartSlots <= 1 << 16);

// Triangles of a warp's leaf pairs at t = 0: slot = leaf pair, side, row.
struct StartShared {
  float coordinate[9][kStartSlots];
  const Triangle* triangles[kLeafPairsOfWarp][2];  // the first of each leaf
  int32_t pair[kLeafPairsOfWarp];
  float distance[kLeafPairsOfWarp];
  bool is_one_body[kLeafPairsOfWarp];
  uint16_t listed[kLeafPairsOfWarp * kTrianglePairs];  // triangle pairs: slot of i * kStartSlots + slot of j
};

template <class Bodies>
class StartVisitor {
 public:
  __device__ StartVisitor(const Pairs<Bodies>& pairs, StartShared& shared, CandidateSink out)
      : pairs_(pairs), shared_(shared), out_(out), lane_(threadIdx.x % kWarp) {}

  // Eight lanes each have one leaf pair, or none. Called by whole warps.
  __device__ void visit(const LeafPair& item, bool has_pair) {
    list(item, has_pair);
    test();
  }

 private:
  __device__ __forceinline__ void list(const LeafPair& item, bool has_pair) {
    const int of_warp = lane_ / kMaxLeafTriangles, row = lane_ % kMaxLeafTriangles;
    bool is_one_leaf = false;
    if (has_pair) {
      const auto& sweep = pairs_.sweeps[item.pair];
      is_one_leaf = sweep.is_one_body() && item.leaves.first == item.leaves.second;
      if (row == 0) {
        shared_.pair[of_warp] = item.pair;
        shared_.distance[of_warp] = sweep.start_distance;
        shared_.is_one_body[of_warp] = sweep.is_one_body();
      }
    }
    uint32_t reaching[2];
    for (int side = 0; side < 2; ++side) {
      const uint32_t lanes = __ballot_sync(kAllLanes, has_pair && load(item, side, of_warp, row));
      reaching[side] = lanes >> (lane_ - row) & ((1u << kMaxLeafTriangles) - 1u);
    }
    uint32_t others = (reaching[0] >> row & 1u) != 0 ? reaching[1] : 0u;
    if (is_one_leaf) others &= ~((2u << row) - 1u);  // of mirror images one is tested
    int at = sum_before(__popc(others), lane_, listed_);
    const int slot_i = kTrianglesOfLeafPair * of_warp + row, first_j = slot_i - row + kMaxLeafTriangles;
    for (; others != 0; others &= others - 1) {
      const int slot_j = first_j + __ffs(static_cast<int>(others)) - 1;
      shared_.listed[at++] = static_cast<uint16_t>(slot_i * kStartSlots + slot_j);
    }
  }

  __device__ __forceinline__ void test() {
    __syncwarp();  // triangles and list are written
    // The planes of neighbouring triangles of one surface do not separate them.
    keep([&](int i, int j) {
      Vec3<float> of_i[3], of_j[3];
      corners(i, of_i);
      corners(j, of_j);
      return is_one_body(i) || !planes_separate(of_i, of_j, distance(i), false);
    });
    keep([&](int i, int j) {
      Vec3<float> of_i[3], of_j[3];
      corners(i, of_i);
      corners(j, of_j);
      return is_one_body(i) || !edges_separate(of_i, of_j, distance(i), false);
    });
    for (int k = lane_; k < listed_; k += kWarp) emit(shared_.listed[k] / kStartSlots, shared_.listed[k] % kStartSlots);
    __syncwarp();  // before the next triangles are written
  }

  // Stores a triangle of a leaf. True if it reaches into the other leaf's sphere.
  __device__ bool load(const LeafPair& item, int side, int of_warp, int row) {
    const PairTree<Bodies> tree = pairs_.tree(item.pair);
    const int32_t own = side == 0 ? item.leaves.first : item.leaves.second;
    const int32_t other = side == 0 ? item.leaves.second : item.leaves.first;
    const NodeLink link = tree.link(side, own);
    if (row == 0) {
      const Triangle* of_body = pairs_.bodies.meshes.triangles + tree.sweep().first_face[side];
      shared_.triangles[of_warp][side] = of_body + link.first;
    }
    if (row >= link.triangle_count) return false;
    Vec3<float> x[3];
    triangle_at_start(tree, side, link.first + row, x);
    const Vec3<float> centre[1] = {tree.centre_at_start(1 - side, other)};
    if (is_outside(x, centre, tree.local_radius(1 - side, other) + tree.sweep().start_distance)) return false;
    const int slot = kTrianglesOfLeafPair * of_warp + kMaxLeafTriangles * side + row;
    PGCCD_UNROLL
    for (int c = 0; c < 3; ++c) {
      shared_.coordinate[3 * c][slot] = x[c].x;
      shared_.coordinate[3 * c + 1][slot] = x[c].y;
      shared_.coordinate[3 * c + 2][slot] = x[c].z;
    }
    return true;
  }

  // Keeps the listed triangle pairs for which the test holds.
  template <class Test>
  __device__ __forceinline__ void keep(Test&& test) {
    int kept = 0;
    PGCCD_KEEP_LOOP
    for (int begin = 0; begin < listed_; begin += kWarp) {
      const bool is_given = begin + lane_ < listed_;
      const int code = is_given ? shared_.listed[begin + lane_] : 0;
      const bool holds = is_given && test(code / kStartSlots, code % kStartSlots);
      const uint32_t lanes = __ballot_sync(kAllLanes, holds);
      __syncwarp();  // all have read what some overwrite
      if (holds) shared_.listed[kept + __popc(lanes & lanes_below(lane_))] = static_cast<uint16_t>(code);
      kept += __popc(lanes);
    }
    listed_ = kept;
    __syncwarp();  // the list is written
  }

  // The edges and faces of two triangles that may pass through one another.
  __device__ void emit(int i, int j) {
    const int of_warp = i / kTrianglesOfLeafPair;
    const Triangle& ti = shared_.triangles[of_warp][0][i % kMaxLeafTriangles];
    const Triangle& tj = shared_.triangles[of_warp][1][j % kMaxLeafTriangles];
    const auto corner_of = [&](int side, int index) { return corner(side == 0 ? i : j, index); };
    PGCCD_KEEP_LOOP
    for (uint32_t bits = represented_crossings(ti, tj, is_one_body(i)); bits != 0; bits &= bits - 1) {
      const int bit = __ffs(static_cast<int>(bits)) - 1;
      if (crossing_apart(corner_of, bit, distance(i), false)) continue;
      emit_crossing(ti, tj, bit, is_one_body(i), [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
        const Candidate candidate{shared_.pair[of_warp], static_cast<int32_t>(kind), feature_i, feature_j};
        out_.put(false, warp_append(&out_.counts->back), candidate);
      });
    }
  }

  __device__ __forceinline__ Vec3<float> corner(int slot, int index) const {
    const int row = 3 * index;
    return {shared_.coordinate[row][slot], shared_.coordinate[row + 1][slot], shared_.coordinate[row + 2][slot]};
  }
  __device__ __forceinline__ void corners(int slot, Vec3<float> (&x)[3]) const {
    PGCCD_UNROLL
    for (int c = 0; c < 3; ++c) x[c] = corner(slot, c);
  }
  __device__ __forceinline__ float distance(int slot) const { return shared_.distance[slot / kTrianglesOfLeafPair]; }
  __device__ __forceinline__ bool is_one_body(int slot) const {
    return SweepOf<Bodies>::may_be_one_body && shared_.is_one_body[slot / kTrianglesOfLeafPair];
  }

  const Pairs<Bodies>& pairs_;
  StartShared& shared_;
  const CandidateSink out_;
  const int lane_;
  int listed_ = 0;
};

template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    visit_starts(Pairs<Bodies> pairs, LeafPairList leaves, CandidateSink out) {
  wait_for_previous_kernels();
  __shared__ StartShared shared[kWarpsPerBlock];
  StartVisitor<Bodies> visitor(pairs, shared[threadIdx.x / kWarp], out);
  const uint32_t lane = threadIdx.x % kWarp, count = leaves.size();
  const WarpShare share = share_of_warp(count);
  for (uint32_t begin = share.begin; begin < count; begin += share.stride) {
    const uint32_t own = begin + lane;
    // Others are certainly apart at t = 0.
    const bool may_be_near = lane < share.lanes && own < count && !(leaves.items[own].begin > 0.0f);
    uint32_t near = __ballot_sync(kAllLanes, may_be_near);
    while (near != 0) {
      uint32_t taken = count;
      for (uint32_t k = 0; k < kLeafPairsOfWarp && near != 0; ++k, near &= near - 1) {
        if (lane / kMaxLeafTriangles == k) taken = begin + __ffs(static_cast<int>(near)) - 1;
      }
      const bool has_pair = taken < count;
      visitor.visit(has_pair ? leaves.items[taken] : LeafPair{}, has_pair);
    }
  }
}

}  // namespace pgccd
