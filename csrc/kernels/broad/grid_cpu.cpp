#include <algorithm>
#include <memory>
#include <numeric>

#include "kernels/broad/broad.h"
#include "kernels/broad/grid_frame.h"
#include "kernels/broad/pair_list.h"

namespace pgccd {
namespace {

constexpr int64_t kGrain = 4096;

GridFrame choose_frame(const BroadBodies& bodies) {
  const int64_t stride = sample_stride(bodies.count);
  const double weight = sample_weight(bodies.count);
  double mean_middle[3] = {}, mean_extent[3] = {};
  for (int64_t b = 0; b < bodies.count; b += stride) {
    const SweptBox box = swept_box(bodies, b);
    for (int k = 0; k < 3; ++k) {
      mean_middle[k] += weight * component(middle_of(box), k);
      mean_extent[k] += weight * component(box.upper - box.lower, k);
    }
  }
  const GridFrame unit = unit_frame(mean_middle, mean_extent);
  double counts[kSizeClasses] = {};
  for (int64_t b = 0; b < bodies.count; b += stride) counts[size_class(unit_size(unit, swept_box(bodies, b)))] += 1.0;
  const double end = best_end(counts);
  double cell_size = 0.5 * end;
  for (int64_t b = 0; b < bodies.count; b += stride)
    cell_size = larger(folded_size(unit_size(unit, swept_box(bodies, b)), end), cell_size);
  return scaled_frame(unit, cell_size);
}

// Bodies in the order of their buckets.
struct SortedCells {
  std::unique_ptr<uint32_t[]> start;  // position of each bucket's first body; one more than there are buckets
  std::unique_ptr<FilterBox[]> boxes;
  std::unique_ptr<GridCell[]> cells;
  uint64_t levels = 0;  // bit set of those that hold bodies
};

uint32_t world_of(const BroadBodies& bodies, int64_t body) {
  return bodies.world ? static_cast<uint32_t>(bodies.world[body]) : 0u;
}

SortedCells sort_cells(const Executor& executor, const BroadBodies& bodies, const GridFrame& frame,
                       const GridTable& table) {
  const int64_t count = bodies.count, bucket_count = table.bucket_count();
  const bool alone = executor.worker_count() == 1;
  struct Place {
    uint32_t bucket, rank;
  };
  SortedCells sorted;
  sorted.start = std::make_unique<uint32_t[]>(bucket_count + 1);
  const auto places = std::make_unique_for_overwrite<Place[]>(count);
  const auto cells = std::make_unique_for_overwrite<GridCell[]>(count);
  std::vector<uint64_t> levels(executor.worker_count(), 0);
  parallel_chunks(executor, count, kGrain, [&](int worker, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      const GridSpan span = grid_span(frame, swept_box(bodies, b));
      const uint32_t level = grid_level(span);
      levels[worker] |= uint64_t{1} << level;
      cells[b] = grid_cell(span, level);
      const uint32_t bucket = table.bucket(cells[b], world_of(bodies, b));
      places[b] = {bucket, add_shared(sorted.start[bucket], 1u, alone)};
    }
  });
  for (const uint64_t part : levels) sorted.levels |= part;
  std::exclusive_scan(&sorted.start[0], &sorted.start[bucket_count + 1], &sorted.start[0], 0u);

  sorted.boxes = std::make_unique_for_overwrite<FilterBox[]>(count + kScanPadding);
  sorted.cells = std::make_unique_for_overwrite<GridCell[]>(count + kScanPadding);
  const Vec3<double> origin{frame.origin[0], frame.origin[1], frame.origin[2]};
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      const int64_t position = sorted.start[places[b].bucket] + places[b].rank;
      sorted.boxes[position] = filter_box(bodies, origin, b);
      sorted.cells[position] = cells[b];
    }
  });
  return sorted;
}

}  // namespace

void grid_cpu(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output) {
  if (bodies.count < 2) {
    make_output(0);
    return;
  }
  const GridFrame frame = choose_frame(bodies);
  const GridTable table = grid_table(bodies.count);
  const SortedCells sorted = sort_cells(executor, bodies, frame, table);
  const bool one_level = std::has_single_bit(sorted.levels);

  std::vector<PairCollector> collectors(executor.worker_count(), PairCollector(bodies, sorted.boxes.get()));
  constexpr int64_t kSearchGrain = 512;
  parallel_chunks(executor, bodies.count, kSearchGrain, [&](int worker, int64_t begin, int64_t end) {
    PairCollector& collector = collectors[worker];
    for (int64_t p = begin; p < end; ++p) {
      const GridCell cell = sorted.cells[p];
      const int64_t body = sorted.boxes[p].body;
      const uint32_t world = world_of(bodies, body);
      const BoxOverlap overlap(sorted.boxes[p]);
      const auto scan = [&](const GridRun& run, auto keep) {
        collector.scan(p, overlap, run.starts_with(cell) ? p + 1 : sorted.start[run.first_bucket],
                       sorted.start[run.last_bucket + 1], keep);
      };
      const auto scan_and_verify = [&](const GridRun& run) {
        if (sorted.start[run.first_bucket] != sorted.start[run.last_bucket + 1])
          scan(run, [&](int64_t other) { return run.contains(sorted.cells[other]); });
      };
      if (one_level && table.in_one_tile(cell)) {
        table.visit_runs_in_tile<true>(cell, world,
                                       [&](const GridRun& run) { scan(run, [](int64_t) { return true; }); });
        continue;
      }
      table.visit_runs<true>(cell, world, scan_and_verify);
      for (uint64_t rest = sorted.levels >> cell.level() >> 1 << cell.level() << 1; rest != 0; rest &= rest - 1) {
        const uint32_t level = static_cast<uint32_t>(lowest_bit(rest));
        const bool near = level <= cell.level() + kCoarserLevels;
        table.visit_runs<false>(
            near ? coarser_cell(cell, level) : grid_cell(grid_span(frame, swept_box(bodies, body)), level), world,
            scan_and_verify);
      }
    }
  });
  write_sorted(executor, take_all(collectors), bodies.count, make_output);
}

}  // namespace pgccd
