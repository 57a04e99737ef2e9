// Start of the test of a body against itself: pairs of nodes that share a block, and pairs of a leaf and itself.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/task_queue.cuh"
#include "kernels/traverse/traverse_counters.h"

namespace pgccd {

// Rounds before a group returns its stack in a test of a body against itself: a few large parts of the tree hold most
// of the work, and should be distributed soon.
constexpr int kSelfPairRounds = 4;

// The rows of self pairs, and the blocks of their hierarchies, concatenated.
struct SelfPairs {
  Counter* reserved;  // the number of rows in the upper half, of blocks in the lower
  Counter* blocks;    // all of them: the lower half may not hold them
  uint32_t* begin;    // (rows) first of its blocks
  int32_t* pair;      // (rows)
  int64_t most;       // capacity in rows

  template <class Bodies>
  __device__ void add_if_one_body(const Bodies& bodies, const SweepOf<Bodies>& sweep, int32_t row) const {
    if constexpr (SweepOf<Bodies>::may_be_one_body) {
      if (!sweep.is_one_body()) return;
      const int32_t count = PairTree<Bodies>(bodies, sweep, nullptr).block_count();
      atomicAdd(this->blocks, static_cast<Counter>(count));
      const Counter at = atomicAdd(reserved, (Counter{1} << 32) + static_cast<uint32_t>(count));
      // A carry out of the lower half shifts rows, but then the result is discarded; no row is past the last one.
      const Counter place = at >> 32;
      if (!has_place(place, most)) return;
      begin[place] = static_cast<uint32_t>(at);
      pair[place] = row;
    }
  }
};

// One warp per block.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    start_self_pairs(Pairs<Bodies> pairs, SelfPairs self_pairs, LeafPairList leaves, TaskList rest,
                     Counter* node_tests) {
  wait_for_previous_kernels();
  if (pairs.count() == 0 || !fits(*self_pairs.blocks, kMostSelfBlocks)) return;
  const uint32_t row_count = static_cast<uint32_t>(*self_pairs.reserved >> 32);
  const uint32_t block_count = static_cast<uint32_t>(*self_pairs.reserved);
  const uint32_t warps = gridDim.x * kWarpsPerBlock;
  const int lane = threadIdx.x % kWarp;
  uint32_t visited = 0;
  for (uint32_t item = (blockIdx.x * blockDim.x + threadIdx.x) / kWarp; item < block_count; item += warps) {
    // The last row whose first block is not after this one.
    uint32_t row = 0;
    for (uint32_t end = row_count; end - row > 1;) {
      const uint32_t middle = row + (end - row) / 2;
      (self_pairs.begin[middle] <= item ? row : end) = middle;
    }
    const int32_t pair = self_pairs.pair[row], block = static_cast<int32_t>(item - self_pairs.begin[row]);
    const PairTree<Bodies> tree = pairs.tree(pair);
    if (lane < kPairsInBlock) {
      int slot = 0, other = lane;
      for (; other >= kBlockWidth - 1 - slot; ++slot) other -= kBlockWidth - 1 - slot;
      other += slot + 1;
      const SplitPair siblings = with_siblings(block, slot);
      bool meets = false;
      for (int k = 1; k <= tree.sweep().segment_count && !meets; ++k) {
        meets = may_meet(tree.clearance(siblings, tree.other_node(siblings, k), k, other));
      }
      const NodePair nodes = siblings.child(other);
      const bool is_leaf = meets && tree.is_leaf_pair(nodes);
      if (is_leaf) leaves.put(warp_append(leaves.count), {pair, nodes});
      if (meets && !is_leaf) rest.put(warp_append(rest.count), {pair, tree.split(nodes)});
    }
    const int32_t node = block * kBlockWidth + lane;
    if (lane < kBlockWidth && tree.is_leaf(0, node)) leaves.put(warp_append(leaves.count), {pair, {node, node}});
    ++visited;
  }
  if (lane == 0 && visited > 0) atomicAdd(node_tests, static_cast<Counter>(visited) * kPairsInBlock);
}

}  // namespace pgccd
