#include <cub/cub.cuh>

#include "kernels/broad/filter_box.h"
#include "kernels/broad/grid_frame.h"
#include "kernels/broad/pair_list.cuh"
#include "kernels/broad/scene_sample.cuh"

namespace pgccd {
namespace {

// By one block.
__global__ void __launch_bounds__(kSampleThreads) choose_frame(BroadBodies bodies, GridFrame* frame) {
  __shared__ BlockSample sample;
  const double weight = sample_weight(bodies.count);
  double mean_middle[3] = {}, mean_extent[3] = {};
  sample.for_each(bodies, [&](const SweptBox& box) {
    for (int k = 0; k < 3; ++k) {
      mean_middle[k] += weight * component(middle_of(box), k);
      mean_extent[k] += weight * component(box.upper - box.lower, k);
    }
  });
  for (int k = 0; k < 3; ++k) {
    mean_middle[k] = sample.sum(mean_middle[k]);
    mean_extent[k] = sample.sum(mean_extent[k]);
  }
  const GridFrame unit = unit_frame(mean_middle, mean_extent);
  double counts[kSizeClasses] = {};
  sample.for_each(bodies, [&](const SweptBox& box) {
    const int found = size_class(unit_size(unit, box));
    for (int c = 0; c < kSizeClasses; ++c) counts[c] += c == found ? 1.0 : 0.0;
  });
  for (double& count : counts) count = sample.sum(count);
  const double end = best_end(counts);
  double cell_size = 0.5 * end;
  sample.for_each(bodies,
                  [&](const SweptBox& box) { cell_size = larger(folded_size(unit_size(unit, box), end), cell_size); });
  cell_size = sample.maximum(cell_size);
  if (threadIdx.x == 0) *frame = scaled_frame(unit, cell_size);
}

__device__ uint32_t world_of(const BroadBodies& bodies, int64_t body) {
  return bodies.world ? static_cast<uint32_t>(bodies.world[body]) : 0u;
}

struct Place {
  uint32_t bucket, rank;
};

struct UnsortedCells {
  GridCell* cells;
  Place* places;
  uint32_t* bucket_counts;
  unsigned long long* levels;  // bit set of those that hold bodies
};

__global__ void __launch_bounds__(kBlockThreads)
    find_cells(BroadBodies bodies, const GridFrame* frame, GridTable table, UnsortedCells out) {
  __shared__ unsigned long long block_levels;
  if (threadIdx.x == 0) block_levels = 0;
  __syncthreads();
  const GridFrame own_frame = *frame;
  unsigned long long levels = 0;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t b = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; b < bodies.count; b += stride) {
    const GridSpan span = grid_span(own_frame, swept_box(bodies, b));
    const uint32_t level = grid_level(span);
    levels |= 1ull << level;
    const GridCell cell = grid_cell(span, level);
    out.cells[b] = cell;
    const uint32_t bucket = table.bucket(cell, world_of(bodies, b));
    out.places[b] = {bucket, atomicAdd(&out.bucket_counts[bucket], 1u)};
  }
  atomicOr(&block_levels, levels);
  __syncthreads();
  if (threadIdx.x == 0) atomicOr(out.levels, block_levels);
}

struct SortedCells {
  const uint32_t* start;  // position of each bucket's first body; one more than there are buckets
  const FilterBox* boxes;
  const GridCell* cells;
  const unsigned long long* levels;
};

__global__ void __launch_bounds__(kBlockThreads)
    find_candidates(BroadBodies bodies, const GridFrame* frame, GridTable table, SortedCells sorted, PairList out) {
  __shared__ PairBuffer buffer;
  buffer.clear();
  const int64_t p = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (p < bodies.count) {
    const FilterBox self = sorted.boxes[p];
    const GridCell cell = sorted.cells[p];
    const uint32_t world = world_of(bodies, self.body);
    const unsigned long long levels = *sorted.levels;
    const bool one_level = (levels & (levels - 1)) == 0;
    const auto scan = [&](const GridRun& run, bool verify) {
      const uint32_t begin = run.starts_with(cell) ? static_cast<uint32_t>(p) + 1u : sorted.start[run.first_bucket];
      const uint32_t end = sorted.start[run.last_bucket + 1];
      for (uint32_t q = begin; q < end; ++q) {
        const FilterBox other = sorted.boxes[q];
        if (!boxes_overlap(self, other) || !balls_meet(self, other)) continue;
        if (verify && !run.contains(sorted.cells[q])) continue;
        buffer.append(out, pack_pair(self.body, other.body));
      }
    };
    if (one_level && table.in_one_tile(cell)) {
      table.visit_runs_in_tile<true>(cell, world, [&](const GridRun& run) { scan(run, false); });
    } else {
      table.visit_runs<true>(cell, world, [&](const GridRun& run) { scan(run, true); });
      for (unsigned long long rest = levels >> cell.level() >> 1 << cell.level() << 1; rest != 0; rest &= rest - 1) {
        const uint32_t level = static_cast<uint32_t>(lowest_bit(rest));
        const bool near = level <= cell.level() + kCoarserLevels;
        const GridCell coarser =
            near ? coarser_cell(cell, level) : grid_cell(grid_span(*frame, swept_box(bodies, self.body)), level);
        table.visit_runs<false>(coarser, world, [&](const GridRun& run) { scan(run, true); });
      }
    }
  }
  buffer.flush(out);
}

}  // namespace

void grid_cuda(const DeviceContext& context, const BroadBodies& bodies, const PairOutput& make_output) {
  const int64_t count = bodies.count;
  if (count < 2) {
    make_output(0);
    return;
  }
  const GridTable table = grid_table(count);
  const int64_t bucket_count = table.bucket_count();
  GridFrame* frame = context.allocate<GridFrame>(1);
  auto* levels = context.allocate<unsigned long long>(1);
  GridCell* unsorted_cells = context.allocate<GridCell>(count);
  Place* places = context.allocate<Place>(count);
  uint32_t* start = context.allocate<uint32_t>(bucket_count + 1);
  fill_bytes(context, levels, 0, 1);
  fill_bytes(context, start, 0, bucket_count + 1);
  choose_frame<<<1, kSampleThreads, 0, context.stream>>>(bodies, frame);
  find_cells<<<resident_blocks(16), kBlockThreads, 0, context.stream>>>(bodies, frame, table,
                                                                        {unsorted_cells, places, start, levels});
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, start, start, bucket_count + 1, context.stream);
  });

  FilterBox* boxes = context.allocate<FilterBox>(count);
  GridCell* cells = context.allocate<GridCell>(count);
  for_each_item(context, count, [=] __device__(int64_t b) {
    const Place place = places[b];
    const int64_t position = static_cast<int64_t>(start[place.bucket]) + place.rank;
    boxes[position] = filter_box(bodies, {frame->origin[0], frame->origin[1], frame->origin[2]}, b);
    cells[position] = unsorted_cells[b];
  });

  collect_pairs(context, bodies, make_output, [&](const PairList& list) {
    const auto blocks = static_cast<unsigned>((count + kBlockThreads - 1) / kBlockThreads);
    find_candidates<<<blocks, kBlockThreads, 0, context.stream>>>(bodies, frame, table, {start, boxes, cells, levels},
                                                                  list);
  });
}

}  // namespace pgccd
