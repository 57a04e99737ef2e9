#include <cub/cub.cuh>

#include "kernels/broad/lbvh_item.h"
#include "kernels/broad/pair_list.cuh"
#include "kernels/broad/scene_sample.cuh"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// One block.
__global__ void __launch_bounds__(kSampleThreads) choose_frame(BroadBodies bodies, LbvhFrame* frame) {
  wait_for_previous_kernels();
  __shared__ BlockSample sample;
  const LbvhFrame chosen = choose_lbvh_frame(sample, bodies);
  if (threadIdx.x == 0) *frame = chosen;
}

__global__ void __launch_bounds__(kBlockThreads) build_nodes(LbvhTree tree, unsigned* arrivals, int32_t* root) {
  wait_for_previous_kernels();
  const int64_t p = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (p >= tree.leaf_count) return;
  const int32_t top = climb(tree, static_cast<int32_t>(p), [&](int32_t node) {
    __threadfence();  // releases writes before the arrival is visible
    const bool second = atomicExch(&arrivals[node], 1u) != 0u;
    __threadfence();  // acquires the first child's writes
    return second;
  });
  if (top >= 0) *root = top;
}

__global__ void __launch_bounds__(kBlockThreads) find_candidates(LbvhTree tree, const int32_t* root, PairList out) {
  wait_for_previous_kernels();
  if (!out.is_wanted()) return;
  __shared__ PairBuffer buffer;
  buffer.clear();
  const int64_t p = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (p < tree.leaf_count) {
    const FilterBox self = tree.leaves[p];
    traverse_lbvh(
        tree, *root, static_cast<int32_t>(p), [&](const auto& box) { return boxes_overlap(self, box); },
        [&](int32_t q) {
          if (balls_meet(self, tree.leaves[q])) buffer.append(out, pack_pair(self.body, tree.leaves[q].body));
        });
  }
  buffer.flush(out);
}

}  // namespace

void find_pairs_by_lbvh(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out) {
  const int64_t count = bodies.count;
  LbvhFrame* frame = context.allocate<LbvhFrame>(1);
  launch_kernel(context, choose_frame, 1, kSampleThreads, bodies, frame);
  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted_keys = context.allocate<uint64_t>(count);
  int32_t* order = context.allocate<int32_t>(count);
  int32_t* sorted_order = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t b) {
    keys[b] = lbvh_key(bodies, *frame, b);
    order[b] = static_cast<int32_t>(b);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, order, sorted_order, count, 0, 64,
                                           context.stream);
  });
  FilterBox* leaves = context.allocate<FilterBox>(count);
  for_each_item(context, count, [=] __device__(int64_t p) {
    leaves[p] = filter_box(bodies, {frame->origin[0], frame->origin[1], frame->origin[2]}, sorted_order[p]);
  });

  const LbvhTree tree{sorted_keys, leaves, context.allocate<LbvhNode>(count - 1), count, bodies.world != nullptr};
  unsigned* arrivals = context.allocate<unsigned>(count - 1);
  int32_t* root = context.allocate<int32_t>(1);
  fill_bytes(context, arrivals, 0, count - 1);
  launch_kernel(context, build_nodes, blocks_for(count), kBlockThreads, tree, arrivals, root);
  collect_pairs(context, bodies, out, [&](const PairList& list) {
    launch_kernel(context, find_candidates, blocks_for(count), kBlockThreads, tree, root, list);
  });
}

}  // namespace pgccd
