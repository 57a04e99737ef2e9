// Shared memory of a warp that visits pairs of leaves, and its output of candidates.
#pragma once

#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/task_queue.cuh"

namespace pgccd {

constexpr int kHalf = kWarp / 2;
constexpr int kTrianglePairs = kMaxLeafTriangles * kMaxLeafTriangles;
static_assert(kMaxLeafTriangles == 8 && kHalf == 2 * kMaxLeafTriangles);

// Maximum number of triangles that a warp stores at a time.
constexpr int kSlots = 64;
static_assert(kSlots >= kWarp && kSlots * kSlots * 16 <= 1 << 16);

struct LeafShared {
  // One column per triangle, so that lanes reading different triangles use different banks: x, y, z of three corners at
  // the start of the segment, then at its end.
  float coordinate[18][kSlots];
  const Triangle* triangle[kSlots];
  float distance[kSlots];
  int32_t pair[kSlots];
  uint8_t lane[kSlots];                           // that loaded it: leaf pair, side, row
  bool remembers[kSlots];                         // many segments, in which the same feature pair may meet
  bool is_one_body[kSlots], is_one_leaf[kSlots];  // both sides are; written where a body may be tested against itself
  uint16_t triangle_pairs[5 * kWarp];             // waiting: slot of i * kSlots + slot of j
  uint16_t features[kWarp * (kFeaturePairBits + 1)];  // waiting: triangle pair * 16 + bit
  uint16_t near[2 * kWarp];                           // likewise: not rejected by `plainly_apart`
  alignas(4) uint16_t met[2 * kTrianglePairs];        // feature pairs emitted so far, if there are many segments
};

// Position of two triangles in `met`, by the lanes that loaded them.
__device__ inline int met_place(const LeafShared& shared, int slot_i, int slot_j) {
  const int i = shared.lane[slot_i], j = shared.lane[slot_j];
  return i / kHalf * kTrianglePairs + i % kMaxLeafTriangles * kMaxLeafTriangles + j % kMaxLeafTriangles;
}

__device__ inline Vec3<float> corner(const LeafShared& shared, int slot, int index, int end) {
  const int row = 9 * end + 3 * index;
  return {shared.coordinate[row][slot], shared.coordinate[row + 1][slot], shared.coordinate[row + 2][slot]};
}

__device__ inline MovingPoints<3, float> load_triangle(const LeafShared& shared, int slot) {
  MovingPoints<3, float> out;
  for (int c = 0; c < 3; ++c) {
    out.start[c] = corner(shared, slot, c, 0);
    out.end[c] = corner(shared, slot, c, 1);
  }
  return out;
}

__device__ inline void store_triangle(LeafShared& shared, int slot, const MovingPoints<3, float>& triangle) {
  for (int end = 0; end < 2; ++end) {
    for (int c = 0; c < 3; ++c) {
      const Vec3<float> v = end == 0 ? triangle.start[c] : triangle.end[c];
      const int row = 9 * end + 3 * c;
      shared.coordinate[row][slot] = v.x;
      shared.coordinate[row + 1][slot] = v.y;
      shared.coordinate[row + 2][slot] = v.z;
    }
  }
}

__device__ __forceinline__ uint32_t rows_of(uint32_t reaching, int half, int side) {
  return (reaching >> (kHalf * half + kMaxLeafTriangles * side)) & 0xffu;
}
// The lanes of a leaf pair, if triangles of both sides reach the other leaf.
__device__ __forceinline__ uint32_t kept_of_half(uint32_t reaching, int half) {
  const bool both = rows_of(reaching, half, 0) != 0 && rows_of(reaching, half, 1) != 0;
  return both ? reaching & (0xffffu << (kHalf * half)) : 0;
}

// Lists the pairs of the triangles in the lanes `kept`, which are stored from slot `first_slot` on; those of one side
// of a leaf pair have consecutive slots. Returns the number of pairs.
__device__ __forceinline__ int list_triangle_pairs(LeafShared& shared, uint32_t kept, int first_slot, int queued,
                                                   int lane) {
  const int i0 = __popc(rows_of(kept, 0, 0)), j0 = __popc(rows_of(kept, 0, 1));
  const int i1 = __popc(rows_of(kept, 1, 0)), j1 = __popc(rows_of(kept, 1, 1));
  const int of_first = i0 * j0, count = of_first + i1 * j1;
  for (int k = lane; k < count; k += kWarp) {
    const bool is_first = k < of_first;
    const unsigned index = is_first ? k : k - of_first, columns = is_first ? j0 : j1;
    const unsigned p = index / columns, q = index - p * columns;
    const int first = first_slot + (is_first ? 0 : i0 + j0), second = first + (is_first ? i0 : i1);
    shared.triangle_pairs[queued + k] = static_cast<uint16_t>((first + p) * kSlots + second + q);
  }
  return count;
}

// Sum over the lanes before this one; `total` is the sum over all lanes.
__device__ inline int sum_before(int value, int lane, int& total) {
  int sum = value;
  for (int step = 1; step < kWarp; step *= 2) {
    const int other = __shfl_up_sync(kAllLanes, sum, step);
    if (lane >= step) sum += other;
  }
  total = __shfl_sync(kAllLanes, sum, kWarp - 1);
  return sum - value;
}

// Output buffers of candidates of both kinds.
struct CandidateBuffers {
  WarpBuffer<Candidate> edge_edge, vertex_face;
};

class CandidateWriter {
  __device__ auto put(bool is_edge_edge) const {
    return [out = out_, is_edge_edge](Counter at, const Candidate& c) { out.put(is_edge_edge, at, c); };
  }

 public:
  __device__ CandidateWriter(CandidateBuffers& buffers, CandidateSink out) : buffers_(buffers), out_(out) {}

  // Called by whole warps, with a candidate in the lanes that have `meets` set.
  __device__ void add(bool meets, const Candidate& candidate, int lane) {
    const bool is_edge_edge = candidate.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge);
    const uint32_t meeting = __ballot_sync(kAllLanes, meets);
    const uint32_t edge_lanes = __ballot_sync(kAllLanes, meets && is_edge_edge);
    edges_ = buffers_.edge_edge.add(edges_, edge_lanes, candidate, lane, &out_.counts->front, put(true));
    vertices_ =
        buffers_.vertex_face.add(vertices_, meeting & ~edge_lanes, candidate, lane, &out_.counts->back, put(false));
  }
  __device__ void flush(int lane) {
    edges_ = buffers_.edge_edge.flush(edges_, lane, &out_.counts->front, put(true));
    vertices_ = buffers_.vertex_face.flush(vertices_, lane, &out_.counts->back, put(false));
  }

 private:
  CandidateBuffers& buffers_;
  CandidateSink out_;
  int edges_ = 0, vertices_ = 0;  // waiting
};

}  // namespace pgccd
