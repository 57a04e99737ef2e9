// From pairs of leaves to candidates. A warp takes two leaf pairs: half of it places their triangles each, then all of
// it tests the triangle pairs of both, then the feature pairs they stand for, listed first so that lanes are full.
#pragma once

#include "kernels/traverse/leaf_shared.cuh"

namespace pgccd {

// Tests one listed feature pair a lane (those with `is_given`), and emits the ones that may meet.
template <class Sweep>
__device__ void test_features(LeafShared& shared, int listed, bool is_given, bool remember, CandidateWriter& writer,
                              int lane) {
  const int code = listed / 16, bit = listed % 16;
  const int half = code / kTrianglePairs, p = code / 8 % 8, q = code % 8;
  const auto corner_of = [&](int side, int index, int end) {
    return corner(shared, triangle_slot(half, side, side == 0 ? p : q), index, end);
  };
  const bool meets = is_given && pair_meets(corner_of, bit, shared.distance[half]);
  Candidate candidate{};
  if (meets) {
    const bool is_one_body = Sweep::may_be_one_body && shared.is_one_body[half];
    emit_pair(shared.first_triangle[half][0][p], shared.first_triangle[half][1][q], bit, is_one_body,
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
  using Sweep = typename SweepOf<Bodies>::type;
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
    if constexpr (Sweep::may_be_one_body) {
      shared.is_one_body[half] = tree.sweep().is_one_body();
      shared.is_one_leaf[half] = tree.sweep().is_one_body() && own == other;
    }
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
        const Triangle &first = shared.first_triangle[h][0][p], &second = shared.first_triangle[h][1][q];
        wanted = represented_pairs(first, second);
        if constexpr (Sweep::may_be_one_body) {
          if (shared.is_one_body[h]) wanted &= pairs_without_common_vertex(first, second);
          if (shared.is_one_leaf[h] && q <= p) wanted = 0;
        }
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
        test_features<Sweep>(shared, mine, lane < tested, remember, writer, lane);
      }
      __syncwarp();  // `met` and the list are settled
    }
    __syncwarp();  // the next segment may overwrite the triangles
  }
}

// Leaf pairs from `begin` on.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    visit_leaves(Pairs<Bodies> pairs, TaskList leaves, uint32_t begin, CandidateSink out) {
  __shared__ LeafShared all_shared[kWarpsPerBlock];
  __shared__ CandidateBuffers buffers[kWarpsPerBlock];
  LeafShared& shared = all_shared[threadIdx.x / kWarp];
  CandidateWriter writer(buffers[threadIdx.x / kWarp], out);
  const uint32_t count = leaves.size();
  const uint32_t warps = gridDim.x * kWarpsPerBlock;
  for (uint32_t item = begin + 2 * ((blockIdx.x * blockDim.x + threadIdx.x) / kWarp); item < count; item += 2 * warps) {
    const int taken = count - item < 2 ? 1 : 2;
    visit_two_leaf_pairs(pairs, leaves.items + item, taken, shared, writer);
    __syncwarp();  // the next two may overwrite what was shared
  }
  writer.flush(threadIdx.x % kWarp);
}

}  // namespace pgccd
