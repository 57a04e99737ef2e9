// Level by level: all node pairs of all body pairs wait in one queue, so that body pairs whose costs differ a
// thousandfold still load the device evenly. Eight threads split one node pair; a warp takes a leaf pair.
#include <cub/cub.cuh>

#include "kernels/device.cuh"
#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/traverse_cuda.h"

namespace pgccd {
namespace {

constexpr int kWarp = 32;
constexpr int kWarpsPerBlock = kBlockThreads / kWarp;
// Levels launched before the host asks whether any node pairs are left.
constexpr int kLevelsPerBatch = 10;

struct Task {
  int32_t pair;
  NodePair nodes;
};

struct Queue {
  Task* tasks;
  uint32_t capacity;

  __device__ void put(uint32_t at, Task task) const {
    if (at < capacity) tasks[at] = task;
  }
};

// One counter a list; they count what did not fit as well, so that the host sees how much room is needed.
struct Counters {
  uint32_t level[kLevelsPerBatch + 1];
  uint32_t leaves;
  uint32_t candidates;
  uint32_t poses;
  unsigned long long node_tests;
};

template <class Bodies>
struct Pairs {
  using Sweep = typename SweepOf<Bodies>::type;
  Bodies bodies;
  const Sweep* sweeps;
  const LocalPose* poses;
  const uint32_t* pose_begin;

  __device__ PairTree<Bodies> tree(int32_t pair) const { return {bodies, sweeps[pair], poses + pose_begin[pair]}; }
};

__device__ uint32_t fitting(uint32_t count, uint32_t capacity) { return count < capacity ? count : capacity; }

// Splits the node pairs of one level; the survivors go to the next level, or to the leaves.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    split_level(Pairs<Bodies> pairs, Queue from, Queue to, Queue leaves, Counters* counters, int level) {
  const int slot = threadIdx.x % kBlockWidth;
  const uint32_t count = fitting(counters->level[level], from.capacity);
  const uint32_t groups = gridDim.x * blockDim.x / kBlockWidth;
  for (uint32_t item = (blockIdx.x * blockDim.x + threadIdx.x) / kBlockWidth; item < count; item += groups) {
    const Task task = from.tasks[item];
    const PairTree<Bodies> tree = pairs.tree(task.pair);
    if (tree.is_leaf_pair(task.nodes)) {
      if (slot == 0) leaves.put(atomicAdd(&counters->leaves, 1u), task);
      continue;
    }
    const SplitPair split = tree.split(task.nodes);
    bool meets = false;
    for (int k = 1; k <= tree.sweep().segment_count && !meets; ++k) {
      meets = tree.clearance(split, tree.other_node(split, k), k, slot) <= 0.0f;
    }
    if (slot == 0) atomicAdd(&counters->node_tests, static_cast<unsigned long long>(kBlockWidth));
    if (!meets) continue;
    const Task child{task.pair, split.child(slot)};
    if (tree.is_leaf_pair(child.nodes)) {
      leaves.put(warp_append(&counters->leaves, 1), child);
    } else {
      to.put(warp_append(&counters->level[level + 1], 1), child);
    }
  }
}

// Follows the deepest overlap of each body pair down to one pair of leaves.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    descend_greedily(Pairs<Bodies> pairs, int64_t pair_count, Queue leaves, Counters* counters) {
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (pair >= pair_count) return;
  const PairTree<Bodies> tree = pairs.tree(static_cast<int32_t>(pair));
  NodePair nodes{0, 0};
  unsigned long long tests = 0;
  bool reached = true;
  while (!tree.is_leaf_pair(nodes)) {
    const SplitPair split = tree.split(nodes);
    tests += kBlockWidth;
    const int slot = tree.deepest_child(split);
    if (slot < 0) {
      reached = false;
      break;
    }
    nodes = split.child(slot);
  }
  atomicAdd(&counters->node_tests, tests);
  if (reached) leaves.put(warp_append(&counters->leaves, 1), {static_cast<int32_t>(pair), nodes});
}

struct CandidateQueue {
  Candidate* candidates;
  uint32_t capacity;
};

// A warp's view of one leaf pair over one segment.
struct LeafShared {
  MovingPoints<3, float> triangle[2][kMaxLeafTriangles];
  uint32_t meeting[kMaxLeafTriangles * kMaxLeafTriangles];    // feature pairs emitted so far
  uint32_t surviving[kMaxLeafTriangles * kMaxLeafTriangles];  // triangle pairs of this segment
};

__device__ int nth_set_bit(uint32_t bits, int n) {
  for (; n > 0; --n) bits &= bits - 1;
  return __ffs(static_cast<int>(bits)) - 1;
}

template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    visit_leaves(Pairs<Bodies> pairs, Queue leaves, CandidateQueue out, Counters* counters) {
  __shared__ LeafShared all_shared[kWarpsPerBlock];
  LeafShared& shared = all_shared[threadIdx.x / kWarp];
  const int lane = threadIdx.x % kWarp;
  const uint32_t count = fitting(counters->leaves, leaves.capacity);
  const uint32_t warps = gridDim.x * kWarpsPerBlock;
  for (uint32_t item = (blockIdx.x * blockDim.x + threadIdx.x) / kWarp; item < count; item += warps) {
    const Task task = leaves.tasks[item];
    const PairTree<Bodies> tree = pairs.tree(task.pair);
    const NodeLink link[2] = {tree.link(0, task.nodes.first), tree.link(1, task.nodes.second)};
    const auto triangle = [&](int side, int row) -> const Triangle& {
      const int64_t first = tree.bodies().meshes.offsets[tree.sweep().mesh[side]].face;
      return tree.bodies().meshes.triangles[first + link[side].first + row];
    };
    const float distance = tree.sweep().inflation;
    for (int k = lane; k < kMaxLeafTriangles * kMaxLeafTriangles; k += kWarp) shared.meeting[k] = 0;
    for (int k = 1; k <= tree.sweep().segment_count; ++k) {
      // Lanes 0 to 7: triangles of i; 8 to 15: of j. Which of them reach into the other leaf's sphere?
      bool reaches = false;
      const int side = lane / kMaxLeafTriangles, row = lane % kMaxLeafTriangles;
      if (side < 2 && row < link[side].triangle_count) {
        const MovingPoints<3, float> moving = moving_triangles<float>(tree, side, link[side].first + row, k);
        shared.triangle[side][row] = moving;
        const int32_t other = side == 0 ? task.nodes.second : task.nodes.first;
        reaches =
            !stays_out(moving, tree.moving_centre(1 - side, other, k), tree.local_radius(1 - side, other) + distance);
      }
      const uint32_t reaching = __ballot_sync(~0u, reaches);
      __syncwarp();  // the triangles, and on the first round `meeting`, are written: all lanes may read them
      const uint32_t reaching_i = reaching & 0xffu, reaching_j = (reaching >> kMaxLeafTriangles) & 0xffu;
      const int count_j = __popc(reaching_j), combinations = __popc(reaching_i) * count_j;
      // Triangle pairs, one a lane; the survivors are listed.
      int survivors = 0;
      for (int base = 0; base < combinations; base += kWarp) {
        const int c = base + lane;
        int p = 0, q = 0;
        bool survives = false;
        if (c < combinations) {
          p = nth_set_bit(reaching_i, c / count_j);
          q = nth_set_bit(reaching_j, c % count_j);
          const uint32_t wanted = represented_pairs(triangle(0, p), triangle(1, q)) & ~shared.meeting[8 * p + q];
          survives = wanted != 0 && !triangles_stay_apart(shared.triangle[0][p], shared.triangle[1][q], distance);
        }
        const uint32_t ballot = __ballot_sync(~0u, survives);
        if (survives) shared.surviving[survivors + __popc(ballot & ((1u << lane) - 1u))] = 8 * p + q;
        survivors += __popc(ballot);
      }
      __syncwarp();
      // Half a warp a triangle pair, one feature pair a lane.
      for (int base = 0; base < survivors; base += 2) {
        const int half = lane / 16, bit = lane % 16;
        const bool has_pair = base + half < survivors;
        const uint32_t pq = has_pair ? shared.surviving[base + half] : 0u;
        const Triangle& ti = triangle(0, pq / 8);
        const Triangle& tj = triangle(1, pq % 8);
        bool meets = false;
        if (has_pair && ((represented_pairs(ti, tj) & ~shared.meeting[pq]) >> bit & 1u)) {
          meets = pair_meets(shared.triangle[0][pq / 8], shared.triangle[1][pq % 8], bit, distance);
        }
        const uint32_t ballot = __ballot_sync(~0u, meets);
        if (has_pair && bit == 0) shared.meeting[pq] |= (ballot >> (16 * half)) & 0x7fffu;
        uint32_t first = 0;
        if (lane == 0 && ballot != 0) first = atomicAdd(&counters->candidates, static_cast<uint32_t>(__popc(ballot)));
        first = __shfl_sync(~0u, first, 0);
        const uint32_t at = first + __popc(ballot & ((1u << lane) - 1u));
        if (meets && at < out.capacity) {
          emit_pair(ti, tj, bit, [&](FeatureKind kind, int32_t feature_i, int32_t feature_j) {
            out.candidates[at] = {task.pair, static_cast<int32_t>(kind), feature_i, feature_j};
          });
        }
        __syncwarp();
      }
      __syncwarp();  // all lanes have read: the next segment or leaf pair may overwrite
    }
  }
}

// All public: device lambdas may not be made in private members.
template <class Bodies>
struct Traversal {
  using Sweep = typename SweepOf<Bodies>::type;

  Traversal(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input)
      : context_(context), bodies_(bodies), input_(input), counters_(context.allocate<Counters>(1)) {
    place_pairs();
  }

  // Until everything fits: overflow is counted, never dropped.
  Counters run(CandidateQueue& out) {
    uint32_t queue_capacity = guess(24), leaf_capacity = guess(64),
             candidate_capacity = guess(input_.leading ? 32 : 128);
    for (;;) {
      const Queue queues[2] = {make_queue(queue_capacity), make_queue(queue_capacity)};
      const Queue leaves = make_queue(leaf_capacity);
      out = {context_.allocate<Candidate>(candidate_capacity), candidate_capacity};
      Counters seen{};
      const bool queues_fit = input_.leading ? lead(leaves) : split_all(queues, leaves, seen);
      if (queues_fit) {
        visit_leaves<Bodies><<<resident_blocks(8), kBlockThreads, 0, context_.stream>>>(pairs_, leaves, out, counters_);
        check_cuda(cudaGetLastError(), "visit_leaves");
        seen = read(context_, counters_);
      }
      if (queues_fit && seen.leaves <= leaf_capacity && seen.candidates <= candidate_capacity) return seen;
      for (const uint32_t count : seen.level) queue_capacity = larger(queue_capacity, grown(count, queue_capacity));
      leaf_capacity = grown(seen.leaves, leaf_capacity);
      candidate_capacity = grown(seen.candidates, candidate_capacity);
    }
  }

  uint32_t guess(int64_t per_pair) const {
    return static_cast<uint32_t>(smaller<int64_t>(per_pair * input_.pair_count + 65536, 0xfffffff0));
  }
  static uint32_t grown(uint32_t needed, uint32_t capacity) {
    if (needed <= capacity) return capacity;
    return static_cast<uint32_t>(smaller<int64_t>(needed + int64_t{needed} / 4, 0xfffffff0));
  }
  Queue make_queue(uint32_t capacity) const { return {context_.allocate<Task>(capacity), capacity}; }

  // Sweeps and poses of all body pairs; how many poses each needs depends on how far its bodies turn.
  void place_pairs() {
    const int64_t count = input_.pair_count;
    const Bodies bodies = bodies_;
    const TraverseInput input = input_;
    Sweep* sweeps = context_.allocate<Sweep>(count);
    uint32_t* pose_counts = context_.allocate<uint32_t>(count + 1);
    uint32_t* pose_begin = context_.allocate<uint32_t>(count + 1);
    for_each_item(context_, count + 1, [=] __device__(int64_t pair) {
      if (pair == count) {
        pose_counts[pair] = 0;
        return;
      }
      const double horizon = input.horizon ? input.horizon[pair] : 1.0;
      const Sweep sweep(bodies, input.pairs[2 * pair], input.pairs[2 * pair + 1], input.settings, horizon);
      sweeps[pair] = sweep;
      pose_counts[pair] = sweep.segment_count + 1;
    });
    run_cub(context_, [&](void* scratch, size_t& bytes) {
      return cub::DeviceScan::ExclusiveSum(scratch, bytes, pose_counts, pose_begin, count + 1, context_.stream);
    });
    LocalPose* poses = context_.allocate<LocalPose>(read(context_, pose_begin + count));
    for_each_item(context_, count, [=] __device__(int64_t pair) {
      const Sweep& sweep = sweeps[pair];
      for (int k = 0; k <= sweep.segment_count; ++k) poses[pose_begin[pair] + k] = sweep.pose(bodies, k);
    });
    pairs_ = {bodies, sweeps, poses, pose_begin};
  }

  bool lead(Queue leaves) {
    fill_bytes(context_, counters_, 0, 1);
    const int64_t blocks = (input_.pair_count + kBlockThreads - 1) / kBlockThreads;
    descend_greedily<Bodies><<<static_cast<unsigned>(blocks), kBlockThreads, 0, context_.stream>>>(
        pairs_, input_.pair_count, leaves, counters_);
    check_cuda(cudaGetLastError(), "descend_greedily");
    return true;
  }

  // False if a queue was too small; `seen` then says how large it must be.
  bool split_all(const Queue queues[2], Queue leaves, Counters& seen) {
    fill_bytes(context_, counters_, 0, 1);
    const int64_t count = input_.pair_count;
    const Queue start = queues[0];
    Counters* counters = counters_;
    for_each_item(context_, count, [=] __device__(int64_t pair) {
      start.put(static_cast<uint32_t>(pair), {static_cast<int32_t>(pair), {0, 0}});
      if (pair == 0) counters->level[0] = static_cast<uint32_t>(count);
    });
    for (int from = 0;;) {
      for (int level = 0; level < kLevelsPerBatch; ++level, from = 1 - from) {
        split_level<Bodies><<<resident_blocks(8), kBlockThreads, 0, context_.stream>>>(
            pairs_, queues[from], queues[1 - from], leaves, counters_, level);
        check_cuda(cudaGetLastError(), "split_level");
      }
      seen = read(context_, counters_);
      for (const uint32_t waiting : seen.level) {
        if (waiting > start.capacity) return false;
      }
      if (seen.level[kLevelsPerBatch] == 0) return true;
      // Deep trees: what is left becomes the first level of another batch.
      for_each_item(context_, 1, [=] __device__(int64_t) {
        counters->level[0] = counters->level[kLevelsPerBatch];
        for (int level = 1; level <= kLevelsPerBatch; ++level) counters->level[level] = 0;
      });
    }
  }

  const DeviceContext& context_;
  const Bodies& bodies_;
  const TraverseInput& input_;
  Counters* counters_;
  Pairs<Bodies> pairs_;
};

}  // namespace

template <class Bodies>
void traverse_cuda(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                   const CandidateOutput& make_output, int64_t* node_tests) {
  if (input.pair_count == 0) {
    fill_bytes(context, node_tests, 0, 1);
    make_output(0);
    return;
  }
  CandidateQueue found;
  const Counters seen = Traversal<Bodies>(context, bodies, input).run(found);
  check_cuda(cudaMemcpyAsync(make_output(seen.candidates), found.candidates, seen.candidates * sizeof(Candidate),
                             cudaMemcpyDeviceToDevice, context.stream),
             "cudaMemcpyAsync");
  const int64_t tests = static_cast<int64_t>(seen.node_tests);
  for_each_item(context, 1, [=] __device__(int64_t) { *node_tests = tests; });
}

template void traverse_cuda(const DeviceContext&, const RigidBodies&, const TraverseInput&, const CandidateOutput&,
                            int64_t*);
template void traverse_cuda(const DeviceContext&, const DeformingBodies&, const TraverseInput&, const CandidateOutput&,
                            int64_t*);

}  // namespace pgccd
