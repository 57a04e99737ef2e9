#include <array>
#include <memory>
#include <numeric>

#include "kernels/broad/broad.h"
#include "kernels/broad/grid_frame.h"
#include "kernels/broad/grid_table.h"
#include "kernels/broad/pair_list.h"

namespace pgccd {
namespace {

constexpr int64_t kGrain = 4096;

// Bodies in the order of their buckets.
struct SortedCells {
  GridTables tables;
  std::unique_ptr<uint32_t[]> start;  // index of each bucket's first body; one more entry than buckets
  std::unique_ptr<FilterBox[]> boxes;
  std::unique_ptr<GridCell[]> cells;
  int64_t count;  // number of bodies
};

uint32_t world_of(const BroadBodies& bodies, int64_t body) {
  return bodies.world ? static_cast<uint32_t>(bodies.world[body]) : 0u;
}

// The cells of all bodies, and the number of bodies in each level.
std::unique_ptr<GridCell[]> find_cells(const Executor& executor, const BroadBodies& bodies, const GridFrame& frame,
                                       uint32_t (&level_counts)[kGridLevels]) {
  auto cells = std::make_unique_for_overwrite<GridCell[]>(bodies.count);
  std::vector<std::array<uint32_t, kGridLevels>> counts(executor.worker_count());
  parallel_chunks(executor, bodies.count, kGrain, [&](int worker, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      if (bodies.is_absent(b)) continue;
      const GridSpan span = grid_span(frame, swept_box(bodies, b));
      const uint32_t level = grid_level(span);
      cells[b] = grid_cell(span, level);
      ++counts[worker][level];
    }
  });
  for (const auto& part : counts)
    for (uint32_t level = 0; level < kGridLevels; ++level) level_counts[level] += part[level];
  return cells;
}

SortedCells sort_cells(const Executor& executor, const BroadBodies& bodies, const GridFrame& frame) {
  const int64_t count = bodies.count, bucket_count = most_buckets(count);
  const bool alone = executor.worker_count() == 1;
  uint32_t level_counts[kGridLevels] = {};
  const auto cells = find_cells(executor, bodies, frame, level_counts);
  SortedCells sorted;
  divide_buckets(level_counts, count, sorted.tables);
  sorted.start = std::make_unique<uint32_t[]>(bucket_count + 1);
  struct Place {
    uint32_t bucket, rank;
  };
  const auto places = std::make_unique_for_overwrite<Place[]>(count);
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      if (bodies.is_absent(b)) continue;
      const uint32_t bucket = sorted.tables.of_level[cells[b].level()].bucket(cells[b], world_of(bodies, b));
      places[b] = {bucket, add_shared(sorted.start[bucket], 1u, alone)};
    }
  });
  std::exclusive_scan(&sorted.start[0], &sorted.start[bucket_count + 1], &sorted.start[0], 0u);

  sorted.count = sorted.start[bucket_count];
  sorted.boxes = std::make_unique_for_overwrite<FilterBox[]>(count + kScanPadding);
  sorted.cells = std::make_unique_for_overwrite<GridCell[]>(count + kScanPadding);
  const Vec3<double> origin{frame.origin[0], frame.origin[1], frame.origin[2]};
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      if (bodies.is_absent(b)) continue;
      const int64_t position = sorted.start[places[b].bucket] + places[b].rank;
      sorted.boxes[position] = filter_box(bodies, origin, b);
      sorted.cells[position] = cells[b];
    }
  });
  return sorted;
}

// One body's search.
class GridSearch {
 public:
  GridSearch(const BroadBodies& bodies, const SortedCells& sorted, int64_t position, PairCollector& collector)
      : sorted_(sorted),
        position_(position),
        overlap_(sorted.boxes[position]),
        world_(world_of(bodies, sorted.boxes[position].body)),
        collector_(collector) {}

  // Searches the bodies of one level, in which the body's box starts in `cell`.
  template <bool kLater>
  void look_around(const GridCell& cell) {
    const GridTable& table = sorted_.tables.of_level[cell.level()];
    if (table.in_one_tile(cell)) {
      table.visit_runs_in_tile<kLater>(cell, world_,
                                       [&](const GridRun& run) { scan<kLater>(run, [](int64_t) { return true; }); });
    } else {
      table.visit_runs<kLater>(cell, world_, [&](const GridRun& run) {
        scan<kLater>(run, [&](int64_t other) { return run.contains(sorted_.cells[other]); });
      });
    }
  }

 private:
  template <bool kLater, class Keep>
  void scan(const GridRun& run, Keep&& keep) {
    const int64_t begin = run.starts_at_home ? position_ + 1 : sorted_.start[run.first_bucket];
    const int64_t end = sorted_.start[run.last_bucket + 1];
    // Coarser levels are nearly empty; at a body's own level a lookup costs less than a mispredicted branch.
    if (kLater || begin < end) collector_.scan(position_, overlap_, begin, end, keep);
  }

  const SortedCells& sorted_;
  int64_t position_;
  BoxOverlap overlap_;
  uint32_t world_;
  PairCollector& collector_;
};

}  // namespace

void find_pairs_by_grid(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output) {
  if (bodies.count < 2) {
    make_output(0);
    return;
  }
  const GridFrame frame = choose_grid_frame(ThreadSample(), bodies);
  const SortedCells sorted = sort_cells(executor, bodies, frame);
  std::vector<PairCollector> collectors(executor.worker_count(), PairCollector(bodies, sorted.boxes.get()));
  constexpr int64_t kSearchGrain = 512;
  parallel_chunks(executor, sorted.count, kSearchGrain, [&](int worker, int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      const GridCell cell = sorted.cells[p];
      GridSearch search(bodies, sorted, p, collectors[worker]);
      search.look_around<true>(cell);
      for (uint64_t rest = coarser_levels(sorted.tables.levels, cell.level()); rest != 0; rest &= rest - 1) {
        const uint32_t level = static_cast<uint32_t>(lowest_bit(rest));
        search.look_around<false>(level <= cell.level() + kCoarserLevels
                                      ? coarser_cell(cell, level)
                                      : grid_cell(grid_span(frame, swept_box(bodies, sorted.boxes[p].body)), level));
      }
    }
  });
  write_sorted(executor, take_all(collectors), bodies.count, make_output);
}

}  // namespace pgccd
