#include <atomic>
#include <memory>

#include "kernels/broad/broad.h"
#include "kernels/broad/lbvh_item.h"
#include "kernels/broad/pair_list.h"
#include "kernels/broad/radix_sort.h"

namespace pgccd {
namespace {

constexpr int64_t kGrain = 4096;

// The arrays of an LbvhTree.
struct TreeArrays {
  std::unique_ptr<uint64_t[]> keys;
  std::unique_ptr<FilterBox[]> leaves;
  std::unique_ptr<LbvhNode[]> nodes;
};

TreeArrays sort_leaves(const Executor& executor, const BroadBodies& bodies) {
  const int64_t count = bodies.count;
  const LbvhFrame frame = choose_lbvh_frame(ThreadSample(), bodies);
  std::vector<KeyedBody> keyed(count);
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) keyed[b] = {lbvh_key(bodies, frame, b), static_cast<int32_t>(b)};
  });
  radix_sort(keyed);
  TreeArrays arrays{std::make_unique_for_overwrite<uint64_t[]>(count),
                    std::make_unique_for_overwrite<FilterBox[]>(count),
                    std::make_unique_for_overwrite<LbvhNode[]>(count - 1)};
  const Vec3<double> origin{frame.origin[0], frame.origin[1], frame.origin[2]};
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      arrays.keys[p] = keyed[p].key;
      arrays.leaves[p] = filter_box(bodies, origin, keyed[p].body);
    }
  });
  return arrays;
}

// Returns the root.
int32_t build_nodes(const Executor& executor, const LbvhTree& tree) {
  const auto arrivals = std::make_unique<uint32_t[]>(tree.leaf_count - 1);
  std::atomic<int32_t> root{-1};
  parallel_chunks(executor, tree.leaf_count, kGrain, [&](int, int64_t begin, int64_t end) {
    const auto arrive = [&](int32_t node) {
      return std::atomic_ref<uint32_t>(arrivals[node]).exchange(1u, std::memory_order_acq_rel) != 0u;
    };
    for (int64_t p = begin; p < end; ++p) {
      const int32_t top = climb(tree, static_cast<int32_t>(p), arrive);
      if (top >= 0) root = top;
    }
  });
  return root;
}

}  // namespace

void find_pairs_by_lbvh(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output) {
  if (bodies.count < 2) {
    make_output(0);
    return;
  }
  const TreeArrays arrays = sort_leaves(executor, bodies);
  const LbvhTree tree{arrays.keys.get(), arrays.leaves.get(), arrays.nodes.get(), bodies.count,
                      bodies.world != nullptr};
  const int32_t root = build_nodes(executor, tree);

  std::vector<PairCollector> collectors(executor.worker_count(), PairCollector(bodies, tree.leaves));
  constexpr int64_t kSearchGrain = 512;
  parallel_chunks(executor, bodies.count, kSearchGrain, [&](int worker, int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      const BoxOverlap overlap(tree.leaves[p]);
      traverse_lbvh(
          tree, root, static_cast<int32_t>(p), [&](const auto& box) { return overlap.with(box); },
          [&](int32_t q) { collectors[worker].add(p, q); });
    }
  });
  write_sorted(executor, take_all(collectors), bodies.count, make_output);
}

}  // namespace pgccd
