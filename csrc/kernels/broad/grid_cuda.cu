#include <cub/cub.cuh>

#include "kernels/broad/filter_box.h"
#include "kernels/broad/grid_frame.h"
#include "kernels/broad/grid_table.h"
#include "kernels/broad/pair_list.cuh"
#include "kernels/broad/scene_sample.cuh"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// One block.
__global__ void __launch_bounds__(kSampleThreads) choose_frame(BroadBodies bodies, GridFrame* frame) {
  wait_for_previous_kernels();
  __shared__ BlockSample sample;
  const GridFrame chosen = choose_grid_frame(sample, bodies);
  if (threadIdx.x == 0) *frame = chosen;
}

__device__ uint32_t world_of(const BroadBodies& bodies, int64_t body) {
  return bodies.world ? static_cast<uint32_t>(bodies.world[body]) : 0u;
}

struct LevelCounts {
  uint32_t of_level[kGridLevels];
};

__global__ void __launch_bounds__(kBlockThreads)
    find_cells(BroadBodies bodies, const GridFrame* frame, GridCell* cells, LevelCounts* counts) {
  wait_for_previous_kernels();
  __shared__ LevelCounts block_counts;
  for (uint32_t level = threadIdx.x; level < kGridLevels; level += blockDim.x) block_counts.of_level[level] = 0;
  __syncthreads();
  const GridFrame own_frame = *frame;
  // Consecutive bodies of a thread are mostly of one level.
  uint32_t level = 0, run = 0;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t b = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; b < bodies.count; b += stride) {
    if (bodies.is_absent(b)) continue;
    const GridSpan span = grid_span(own_frame, swept_box(bodies, b));
    const uint32_t found = grid_level(span);
    cells[b] = grid_cell(span, found);
    if (found != level && run != 0) {
      atomicAdd(&block_counts.of_level[level], run);
      run = 0;
    }
    level = found;
    ++run;
  }
  if (run != 0) atomicAdd(&block_counts.of_level[level], run);
  __syncthreads();
  for (uint32_t k = threadIdx.x; k < kGridLevels; k += blockDim.x)
    if (block_counts.of_level[k] != 0) atomicAdd(&counts->of_level[k], block_counts.of_level[k]);
}

// One block.
__global__ void make_tables(const LevelCounts* counts, int64_t body_count, GridTables* tables) {
  wait_for_previous_kernels();
  __shared__ LevelCounts own;  // a single read instead of sequential ones
  if (threadIdx.x < kGridLevels) own.of_level[threadIdx.x] = counts->of_level[threadIdx.x];
  __syncthreads();
  if (threadIdx.x == 0) divide_buckets(own.of_level, body_count, *tables);
}

struct Place {
  uint32_t bucket, rank;
};

struct SortedCells {
  const GridTables* tables;
  const uint32_t* start;  // index of each bucket's first body; one more entry than buckets
  int64_t bucket_count;
  const FilterBox* boxes;
  const GridCell* cells;

  __device__ int64_t count() const { return start[bucket_count]; }
};

__global__ void __launch_bounds__(kBlockThreads)
    find_candidates(BroadBodies bodies, const GridFrame* frame, SortedCells sorted, PairList out) {
  wait_for_previous_kernels();
  if (!out.is_wanted()) return;
  __shared__ PairBuffer buffer;
  buffer.clear();
  const int64_t p = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (p < sorted.count()) {
    const FilterBox self = sorted.boxes[p];
    const GridCell cell = sorted.cells[p];
    const uint32_t world = world_of(bodies, self.body);
    const auto scan = [&](const GridRun& run, bool verify) {
      const uint32_t begin = run.starts_at_home ? static_cast<uint32_t>(p) + 1u : sorted.start[run.first_bucket];
      const uint32_t end = sorted.start[run.last_bucket + 1];
      for (uint32_t q = begin; q < end; ++q) {
        const FilterBox other = sorted.boxes[q];
        if (!boxes_overlap(self, other) || !balls_meet(self, other)) continue;
        if (verify && !run.contains(sorted.cells[q])) continue;
        buffer.append(out, pack_pair(self.body, other.body));
      }
    };
    const GridTable own_table = sorted.tables->of_level[cell.level()];
    if (own_table.in_one_tile(cell)) {
      own_table.visit_runs_in_tile<true>(cell, world, [&](const GridRun& run) { scan(run, false); });
    } else {
      own_table.visit_runs<true>(cell, world, [&](const GridRun& run) { scan(run, true); });
    }
    for (uint64_t rest = coarser_levels(sorted.tables->levels, cell.level()); rest != 0; rest &= rest - 1) {
      const uint32_t level = static_cast<uint32_t>(lowest_bit(rest));
      const GridCell coarser = level <= cell.level() + kCoarserLevels
                                   ? coarser_cell(cell, level)
                                   : grid_cell(grid_span(*frame, swept_box(bodies, self.body)), level);
      const GridTable table = sorted.tables->of_level[level];
      const bool verify = !table.in_one_tile(coarser);
      table.visit_runs<false>(coarser, world, [&](const GridRun& run) { scan(run, verify); });
    }
  }
  buffer.flush(out);
}

}  // namespace

void find_pairs_by_grid(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out) {
  const int64_t count = bodies.count;
  GridFrame* frame = context.allocate<GridFrame>(1);
  LevelCounts* level_counts = context.allocate<LevelCounts>(1);
  GridTables* tables = context.allocate<GridTables>(1);
  GridCell* unsorted_cells = context.allocate<GridCell>(count);
  fill_bytes(context, level_counts, 0, 1);
  launch_kernel(context, choose_frame, 1, kSampleThreads, bodies, frame);
  launch_kernel(context, find_cells, looping_blocks_for(context, count), kBlockThreads, bodies, frame, unsorted_cells,
                level_counts);
  launch_kernel(context, make_tables, 1, kBlockThreads, level_counts, count, tables);

  // Counting sort by bucket; the order within a bucket does not matter.
  const int64_t bucket_count = most_buckets(count);
  uint32_t* start = context.allocate<uint32_t>(bucket_count + 1);
  fill_bytes(context, start, 0, bucket_count + 1);
  Place* places = context.allocate<Place>(count);
  for_each_item(context, count, [=] __device__(int64_t b) {
    if (bodies.is_absent(b)) return;
    const GridCell cell = unsorted_cells[b];
    const uint32_t bucket = tables->of_level[cell.level()].bucket(cell, world_of(bodies, b));
    places[b] = {bucket, atomicAdd(&start[bucket], 1u)};
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, start, start, bucket_count + 1, context.stream);
  });
  FilterBox* boxes = context.allocate<FilterBox>(count);
  GridCell* cells = context.allocate<GridCell>(count);
  for_each_item(context, count, [=] __device__(int64_t b) {
    if (bodies.is_absent(b)) return;
    const Place place = places[b];
    const int64_t position = static_cast<int64_t>(start[place.bucket]) + place.rank;
    boxes[position] = filter_box(bodies, {frame->origin[0], frame->origin[1], frame->origin[2]}, b);
    cells[position] = unsorted_cells[b];
  });

  collect_pairs(context, bodies, out, [&](const PairList& list) {
    launch_kernel(context, find_candidates, blocks_for(count), kBlockThreads, bodies, frame,
                  SortedCells{tables, start, bucket_count, boxes, cells}, list);
  });
}

}  // namespace pgccd
