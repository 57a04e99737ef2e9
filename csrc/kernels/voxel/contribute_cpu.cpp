#include <algorithm>
#include <atomic>

#include "kernels/voxel/triangle_box_item.h"
#include "kernels/voxel/voxel_table.h"

namespace pgccd {
namespace {

constexpr int64_t kBodyGrain = 16;

}  // namespace

void voxels_touched(const Executor& executor, const VoxelBodies& input,
                    const std::function<TouchedVoxels(int64_t)>& make_output) {
  const VoxelGrid grid(input.voxel_size);
  std::vector<VoxelTable> counted(executor.worker_count());
  parallel_chunks(executor, input.bodies.centres.count, kBodyGrain, [&](int worker, int64_t begin, int64_t end) {
    std::vector<CornerBox> corners;
    VoxelTable& table = counted[worker];
    uint64_t last_key = 0;
    int64_t pending = 0;
    for (int64_t body = begin; body < end; ++body) {
      for_each_triangle_box(input, body, corners, [&](const TriangleBox& box) {
        grid.for_each_touched(box, [&](Voxel voxel) {
          const uint64_t key = voxel_key(voxel);
          if (key != last_key && pending > 0) {
            table[last_key] += pending;
            pending = 0;
          }
          last_key = key;
          ++pending;
        });
      });
    }
    if (pending > 0) table[last_key] += pending;
  });
  VoxelTable& all = counted[0];
  for (size_t worker = 1; worker < counted.size(); ++worker) {
    for (const auto& entry : counted[worker].entries()) all[entry.key] += entry.value;
  }
  std::vector<VoxelTable::Entry> entries = all.entries();
  std::sort(entries.begin(), entries.end(), [](const auto& a, const auto& b) { return a.key < b.key; });
  const TouchedVoxels out = make_output(static_cast<int64_t>(entries.size()));
  for (size_t k = 0; k < entries.size(); ++k) {
    out.voxels[k] = voxel_of_key(entries[k].key);
    out.counts[k] = entries[k].value;
  }
}

void voxel_boxes(const Executor& executor, const VoxelBodies& input, const Voxel* voxels, const int64_t* counts,
                 int64_t voxel_count, TriangleBox* boxes) {
  const VoxelGrid grid(input.voxel_size);
  VoxelTable rows(voxel_count);
  std::vector<int64_t> next(voxel_count), ends(voxel_count);
  int64_t place = 0;
  for (int64_t k = 0; k < voxel_count; ++k) {
    rows[voxel_key(voxels[k])] = k;
    next[k] = place;
    place += counts[k];
    ends[k] = place;
  }
  const auto refuse = [] {
    throw std::invalid_argument("voxels, counts: expected the voxels that these bodies touch, each once");
  };
  parallel_chunks(executor, input.bodies.centres.count, kBodyGrain, [&](int, int64_t begin, int64_t end) {
    std::vector<CornerBox> corners;
    uint64_t last_key = ~uint64_t{0};
    int64_t row = 0;
    for (int64_t body = begin; body < end; ++body) {
      for_each_triangle_box(input, body, corners, [&](const TriangleBox& box) {
        grid.for_each_touched(box, [&](Voxel voxel) {
          const uint64_t key = voxel_key(voxel);
          if (key != last_key) {
            const int64_t* found = rows.look_up(key);
            if (found == nullptr) refuse();
            row = *found;
            last_key = key;
          }
          const int64_t at = std::atomic_ref<int64_t>(next[row]).fetch_add(1, std::memory_order_relaxed);
          if (at >= ends[row]) refuse();
          boxes[at] = box;
        });
      });
    }
  });
  if (next != ends) refuse();
}

}  // namespace pgccd
