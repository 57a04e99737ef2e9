#include <algorithm>
#include <numeric>
#include <vector>

#include "kernels/broad/territory.h"
#include "kernels/find_rows.h"

namespace pgccd {
void border_bodies_cpu(const Executor& executor, const BroadBodies& bodies, const Territory& territory, uint8_t* reach,
                       const FoundRows& border) {
  find_rows(executor, bodies.count, border.rows, border.found, [&](int64_t body) {
    reach[body] = reaches_others(bodies, territory, body) ? kReachesOthers : 0;
    return reach[body] != 0;
  });
}

void reached_ranks_cpu(const Executor& executor, const BroadBodies& bodies, const Territory& territory,
                       const int64_t* rows, int64_t row_count, int64_t ranks, uint8_t* reached) {
  std::fill_n(reached, row_count * ranks, uint8_t{0});
  parallel_chunks(executor, row_count, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const CellRange range(territory.frame, swept_box(bodies, rows[row]));
      for (int64_t k = 0; k < range.count(); ++k) {
        reached[row * ranks + territory.owner[territory.frame.index(range[k])]] = 1;
      }
    }
  });
}

void owned_pairs_cpu(const Executor& executor, const OwnedPairs& input, int64_t pair_count, const FoundRows& owned) {
  find_rows(executor, pair_count, owned.rows, owned.found, [&](int64_t pair) { return is_owned(input, pair); });
}

void near_ghosts_cpu(const Executor& executor, const BroadBodies& bodies, const BroadBodies& ghosts,
                     const Territory& territory, const FoundRows& near) {
  std::vector<int64_t> cell_boxes(static_cast<size_t>(6 * territory.frame.cell_count()));
  for (size_t at = 0; at < cell_boxes.size(); ++at) cell_boxes[at] = at % 6 < 3 ? kEmptyLower : kEmptyUpper;
  for (int64_t ghost = 0; ghost < ghosts.count; ++ghost) {
    const SweptBox box = swept_box(ghosts, ghost);
    const CellRange range(territory.frame, box);
    int64_t corners[6];
    ordered_corners(box, corners);
    for (int64_t k = 0; k < range.count(); ++k) {
      const int64_t cell = territory.frame.index(range[k]);
      if (territory.owner[cell] != territory.rank) continue;
      int64_t* around = cell_boxes.data() + 6 * cell;
      for (int axis = 0; axis < 3; ++axis) {
        around[axis] = std::min(around[axis], corners[axis]);
        around[3 + axis] = std::max(around[3 + axis], corners[3 + axis]);
      }
    }
  }
  find_rows(executor, bodies.count, near.rows, near.found,
            [&](int64_t body) { return is_near(bodies, territory.frame, cell_boxes.data(), body); });
}

void leaving_bodies_cpu(const Executor& executor, const double* position, int64_t count, const Territory& territory,
                        int64_t ranks, const LeavingRows& leaving) {
  int64_t found = 0;
  find_rows(executor, count, leaving.rows, &found,
            [&](int64_t body) { return owner_of(territory, position, body) != territory.rank; });
  const auto destination = [&](int64_t k) { return owner_of(territory, position, leaving.rows[k]); };
  std::fill_n(leaving.counts, ranks, int64_t{0});
  for (int64_t k = 0; k < found; ++k) ++leaving.counts[destination(k)];
  std::vector<int64_t> next(static_cast<size_t>(ranks));
  std::exclusive_scan(leaving.counts, leaving.counts + ranks, next.begin(), int64_t{0});
  for (int64_t k = 0; k < found; ++k) {
    leaving.by_destination[next[static_cast<size_t>(destination(k))]++] = leaving.rows[k];
  }
}

}  // namespace pgccd
