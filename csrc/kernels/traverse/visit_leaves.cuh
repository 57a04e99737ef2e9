// From pairs of leaves to candidates. A warp takes two leaf pairs: half of it places their triangles each, then all of
// it tests the triangle pairs of both, then the feature pairs they stand for, listed first so that lanes are full.
#pragma once

#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/task_queue.cuh"

namespace pgccd {

constexpr int kHalf = kWarp / 2;
constexpr int kTrianglePairs = kMaxLeafTriangles * kMaxLeafTriangles;
static_assert(kMaxLeafTriangles == 8 && kHalf == 2 * kMaxLeafTriangles);

// A triangle pair of the warp, 7 bits: which leaf pair, which triangle of i, which of j.
__device__ inline int triangle_pair(int half, int p, int q) { return half * kTrianglePairs + 8 * p + q; }

// The warp's triangles, 16 of each leaf pair: of i, then of j.
__device__ inline int triangle_slot(int half, int side, int row) {
  return half * kHalf + side * kMaxLeafTriangles + row;
}

struct LeafShared {
  // A column a triangle, so that lanes that read different triangles use different banks: x, y, z of three corners at
  // the start of the segment, then at its end.
  float coordinate[18][kWarp];
  const Triangle* first_triangle[2][2];  // leaf pair, side
  float distance[2];
  int32_t pair[2];
  alignas(4) uint16_t met[2 * kTrianglePairs];          // feature pairs emitted so far, where segments are many
  uint16_t features[kWarp * kFeaturePairBits + kWarp];  // waiting: triangle pair * 16 + bit
};

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

__device__ inline int nth_set_bit(uint32_t bits, int n) {
  for (; n > 0; --n) bits &= bits - 1;
  return __ffs(static_cast<int>(bits)) - 1;
}

// Sum over the lanes before this one; the total goes to `total`.
__device__ inline int sum_before(int value, int lane, int& total) {
  int sum = value;
  for (int step = 1; step < kWarp; step *= 2) {
    const int other = __shfl_up_sync(kAllLanes, sum, step);
    if (lane >= step) sum += other;
  }
  total = __shfl_sync(kAllLanes, sum, kWarp - 1);
  return sum - value;
}

// Candidates of both kinds on their way out.
struct CandidateBuffers {
  WarpBuffer<Candidate> edge_edge, vertex_face;
};

class CandidateWriter {
  __device__ auto put(bool is_edge_edge) const {
    return [out = out_, is_edge_edge](uint32_t at, const Candidate& c) { out.put(is_edge_edge, at, c); };
  }

 public:
  __device__ CandidateWriter(CandidateBuffers& buffers, CandidateSink out) : buffers_(buffers), out_(out) {}

  // Called by whole warps, with a candidate in the lanes that have `meets` set.
  __device__ void add(bool meets, const Candidate& candidate, int lane) {
    const bool is_edge_edge = candidate.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge);
    const uint32_t meeting = __ballot_sync(kAllLanes, meets);
    const uint32_t edge_lanes = __ballot_sync(kAllLanes, meets && is_edge_edge);
    edges_ = buffers_.edge_edge.add(edges_, edge_lanes, candidate, lane, out_.edge_edge_count, put(true));
    vertices_ =
        buffers_.vertex_face.add(vertices_, meeting & ~edge_lanes, candidate, lane, out_.vertex_face_count, put(false));
  }
  __device__ void flush(int lane) {
    edges_ = buffers_.edge_edge.flush(edges_, lane, out_.edge_edge_count, put(true));
    vertices_ = buffers_.vertex_face.flush(vertices_, lane, out_.vertex_face_count, put(false));
  }

 private:
  CandidateBuffers& buffers_;
  CandidateSink out_;
  int edges_ = 0, vertices_ = 0;  // waiting
};

// Tests one listed feature pair a lane (those with `is_given`), and emits the ones that may meet.
__device__ inline void test_features(LeafShared& shared, int listed, bool is_given, bool remember,
                                     CandidateWriter& writer, int lane) {
  const int code = listed / 16, bit = listed % 16;
  const int half = code / kTrianglePairs, p = code / 8 % 8, q = code % 8;
  const auto corner_of = [&](int side, int index, int end) {
    return corner(shared, triangle_slot(half, side, side == 0 ? p : q), index, end);
  };
  const bool meets = is_given && pair_meets(corner_of, bit, shared.distance[half]);
  Candidate candidate{};
  if (meets) {
    emit_pair(shared.first_triangle[half][0][p], shared.first_triangle[half][1][q], bit,
              [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
                candidate = {shared.pair[half], static_cast<int32_t>(kind), feature_i, feature_j};
              });
    // Other lanes may mark feature pairs of the same word.
    if (remember) atomicOr(reinterpret_cast<unsigned int*>(shared.met) + code / 2, (1u << bit) << (16 * (code % 2)));
  }
  writer.add(meets, candidate, lane);
}

// `tasks`: two of them, or one at the end of the list.
template <class Bodies>
__device__ void visit_two_leaf_pairs(const Pairs<Bodies>& pairs, const Task* tasks, int count, LeafShared& shared,
                                     CandidateWriter& writer) {
  const int lane = threadIdx.x % kWarp, half = lane / kHalf;
  const int side = lane % kHalf / kMaxLeafTriangles, row = lane % kMaxLeafTriangles;
  const bool has_pair = half < count;
  const Task task = tasks[has_pair ? half : 0];
  const PairTree<Bodies> tree = pairs.tree(task.pair);
  const int32_t own = side == 0 ? task.nodes.first : task.nodes.second;
  const int32_t other = side == 0 ? task.nodes.second : task.nodes.first;
  const NodeLink link = tree.link(side, own);
  const int own_segments = has_pair ? tree.sweep().segment_count : 0;
  const int segments = __reduce_max_sync(kAllLanes, own_segments);
  const bool remember = segments > 1;
  if (row == 0) {
    const int64_t first = tree.sweep().first_face[side] + link.first;
    shared.first_triangle[half][side] = pairs.bodies.meshes.triangles + first;
    shared.distance[half] = tree.sweep().inflation;
    shared.pair[half] = task.pair;
  }
  if (remember) {
    for (int k = lane; k < 2 * kTrianglePairs; k += kWarp) shared.met[k] = 0;
  }
  for (int k = 1; k <= segments; ++k) {
    // Which triangles reach into the other leaf's sphere?
    bool reaches = false;
    if (k <= own_segments && row < link.triangle_count) {
      const MovingPoints<3, float> moving = moving_triangles<float>(tree, side, link.first + row, k);
      store_triangle(shared, lane, moving);
      const float reach = tree.local_radius(1 - side, other) + tree.sweep().inflation;
      reaches = !stays_out(moving, tree.moving_centre(1 - side, other, k), reach);
    }
    const uint32_t reaching = __ballot_sync(kAllLanes, reaches);
    __syncwarp();  // the triangles, and on the first round all the rest, are written: other lanes may read them
    const auto rows_reaching = [&](int h, int s) { return (reaching >> (kHalf * h + kMaxLeafTriangles * s)) & 0xffu; };
    const int split = __popc(rows_reaching(0, 0)) * __popc(rows_reaching(0, 1));
    const int combinations = split + __popc(rows_reaching(1, 0)) * __popc(rows_reaching(1, 1));
    int waiting = 0;
    for (int base = 0; base < combinations; base += kWarp) {
      const int c = base + lane;
      uint32_t wanted = 0;
      int code = 0;
      if (c < combinations) {
        const int h = c < split ? 0 : 1, index = c - h * split;
        const uint32_t rows_j = rows_reaching(h, 1);
        const int count_j = __popc(rows_j);
        const int p = nth_set_bit(rows_reaching(h, 0), index / count_j), q = nth_set_bit(rows_j, index % count_j);
        code = triangle_pair(h, p, q);
        wanted = represented_pairs(shared.first_triangle[h][0][p], shared.first_triangle[h][1][q]);
        if (remember) wanted &= ~static_cast<uint32_t>(shared.met[code]);
        if (wanted != 0 && triangles_stay_apart(load_triangle(shared, triangle_slot(h, 0, p)),
                                                load_triangle(shared, triangle_slot(h, 1, q)), shared.distance[h])) {
          wanted = 0;
        }
      }
      int added = 0;
      int at = waiting + sum_before(__popc(wanted), lane, added);
      for (; wanted != 0; wanted &= wanted - 1) {
        shared.features[at++] = static_cast<uint16_t>(code * 16 + __ffs(static_cast<int>(wanted)) - 1);
      }
      waiting += added;
      __syncwarp();
      const bool is_last = base + kWarp >= combinations;
      while (waiting >= kWarp || (is_last && waiting > 0)) {
        // From the end of the list; the first of the rest stay where they are.
        const int tested = waiting < kWarp ? waiting : kWarp;
        const uint16_t mine = lane < tested ? shared.features[waiting - tested + lane] : uint16_t{0};
        waiting -= tested;
        test_features(shared, mine, lane < tested, remember, writer, lane);
      }
      __syncwarp();  // `met` and the list are settled
    }
    __syncwarp();  // the next segment may overwrite the triangles
  }
}

template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads) visit_leaves(Pairs<Bodies> pairs, TaskList leaves, CandidateSink out) {
  __shared__ LeafShared all_shared[kWarpsPerBlock];
  __shared__ CandidateBuffers buffers[kWarpsPerBlock];
  LeafShared& shared = all_shared[threadIdx.x / kWarp];
  CandidateWriter writer(buffers[threadIdx.x / kWarp], out);
  const uint32_t count = leaves.size();
  const uint32_t warps = gridDim.x * kWarpsPerBlock;
  for (uint32_t item = 2 * ((blockIdx.x * blockDim.x + threadIdx.x) / kWarp); item < count; item += 2 * warps) {
    const int taken = count - item < 2 ? 1 : 2;
    visit_two_leaf_pairs(pairs, leaves.items + item, taken, shared, writer);
    __syncwarp();  // the next two may overwrite what was shared
  }
  writer.flush(threadIdx.x % kWarp);
}

}  // namespace pgccd
