#include <algorithm>
#include <numeric>
#include <vector>

#include "kernels/broad/subdomain.h"
#include "kernels/find_rows.h"

namespace pgccd {
namespace {

void require_owners(const Executor& executor, const Subdomain& subdomain, int64_t ranks) {
  if (subdomain.owner == nullptr) {
    require_rows(executor, subdomain.plane_count, "owner", "are planes above others, or above ranks",
                 [&](int64_t plane) { return is_sound(subdomain.planes[plane], plane, subdomain.plane_count, ranks); });
    return;
  }
  require_rows(executor, subdomain.frame.cell_count(), "owner", "name ranks",
               [&](int64_t cell) { return is_within(subdomain.owner[cell], ranks); });
}

}  // namespace

void swept_boxes(const Executor& executor, const BroadBodies& bodies, double* lower, double* upper) {
  parallel_chunks(executor, bodies.count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) store_swept_box(bodies, body, lower, upper);
  });
}

void boundary_bodies(const Executor& executor, const BroadBodies& bodies, const Subdomain& subdomain, uint8_t* reach,
                     const FoundRows& boundary) {
  find_rows(executor, bodies.count, boundary.rows, boundary.found, [&](int64_t body) {
    reach[body] = reaches_others(bodies, subdomain, body) ? 1 : 0;
    return reach[body] != 0;
  });
  std::fill(boundary.rows + *boundary.found, boundary.rows + bodies.count, int64_t{-1});
}

void replica_ranks(const Executor& executor, const ReplicaRanksInput& input, const ReplicaRanks& out) {
  const Subdomain& subdomain = input.subdomain;
  require_rows(executor, input.row_count, "bodies", "are -1, or those of bodies",
               [&](int64_t k) { return input.rows[k] < input.bodies.count; });
  require_owners(executor, subdomain, out.ranks);
  std::fill_n(out.replica_ranks, input.row_count * out.ranks, uint8_t{0});
  parallel_chunks(executor, input.row_count, 256, [&](int, int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      if (input.rows[k] < 0) continue;
      uint8_t* replica_ranks = out.replica_ranks + k * out.ranks;
      subdomain.any_owner(swept_box(input.bodies, input.rows[k]), [&](int64_t rank) {
        replica_ranks[rank] = 1;
        return false;
      });
      replica_ranks[subdomain.rank] = 0;
    }
  });
  int64_t ghost = 0;
  for (size_t source = 0; source < input.received.size(); ++source) {
    for (int64_t k = 0; k < input.received[source]; ++k, ++ghost) {
      if (input.rows[ghost] >= 0) out.replica_ranks[ghost * out.ranks + int64_t(source)] = 1;
    }
  }
  std::fill_n(out.counts, out.ranks, int64_t{0});
  for (int64_t k = 0; k < input.row_count; ++k) {
    for (int64_t rank = 0; rank < out.ranks; ++rank) out.counts[rank] += out.replica_ranks[k * out.ranks + rank];
  }
}

void reached_ranks(const Executor& executor, const ReachedRanks& input, int64_t* out) {
  require_rows(executor, input.row_count, "bodies", "are those of bodies",
               [&](int64_t k) { return is_within(input.rows[k], input.bodies.count); });
  require_owners(executor, input.subdomain, input.ranks);
  require_rows(executor, input.row_count, "begin", "leave places for all ranks",
               [&](int64_t k) { return input.store(k, out); });
}

void rows_by_rank(const Executor&, const HeldRows& held, const std::vector<int64_t>& capacities, int64_t* by_rank) {
  for (int64_t rank = 0; rank < held.ranks; ++rank) {
    int64_t *at = by_rank, *end = by_rank + capacities[static_cast<size_t>(rank)];
    for (int64_t k = 0; k < held.row_count && at < end; ++k) {
      if (held.replica_ranks[k * held.ranks + rank] != 0) *at++ = held.rows[k];
    }
    by_rank = std::fill_n(at, end - at, int64_t{-1});
  }
}

void counts_to_send(const Executor&, const CapacityInput& input, const std::vector<int64_t>& capacities,
                    int64_t* messages) {
  const int64_t ranks = static_cast<int64_t>(capacities.size());
  const bool is_short = input.is_short(capacities.data(), ranks);
  for (int64_t rank = 0; rank < ranks; ++rank) {
    *messages++ = input.counts[rank];
    *messages++ = is_short ? 1 : 0;
  }
}

void owned_pairs(const Executor& executor, const OwnedPairs& input, int64_t* owned, int64_t* found) {
  require_rows(executor, input.pair_count, "pairs, rows", "are padding, or name bodies held",
               [&](int64_t k) { return is_sound(input, k); });
  std::vector<int64_t> kept(static_cast<size_t>(input.pair_count));
  find_rows(executor, input.pair_count, kept.data(), found, [&](int64_t k) { return is_owned(input, k); });
  for (int64_t k = 0; k < input.pair_count; ++k) store_owned_pair(input, kept.data(), *found, k, owned);
}

void near_ghosts(const Executor& executor, const BroadBodies& bodies, const uint8_t* reach, const BroadBodies& ghosts,
                 const Subdomain& subdomain, const FoundRows& near) {
  const CellRows rows(subdomain.frame);
  std::vector<int64_t> cell_boxes(static_cast<size_t>(6 * rows.size()));
  for (size_t at = 0; at < cell_boxes.size(); ++at) cell_boxes[at] = at % 6 < 3 ? kEmptyLower : kEmptyUpper;
  for (int64_t ghost = 0; ghost < ghosts.count; ++ghost) {
    if (ghosts.is_absent(ghost)) continue;
    const SweptBox box = swept_box(ghosts, ghost);
    const CellRange range(subdomain.frame, box);
    int64_t corners[6];
    ordered_corners(box, corners);
    for (int64_t k = 0; k < range.count(); ++k) {
      if (!subdomain.has_cell(subdomain.frame.index(range[k]))) continue;
      int64_t* around = cell_boxes.data() + 6 * rows.row(range[k]);
      for (int axis = 0; axis < 3; ++axis) {
        around[axis] = std::min(around[axis], corners[axis]);
        around[3 + axis] = std::max(around[3 + axis], corners[3 + axis]);
      }
    }
  }
  find_rows(executor, bodies.count, near.rows, near.found,
            [&](int64_t body) { return is_near(bodies, reach, subdomain.frame, cell_boxes.data(), body); });
}

void leaving_bodies(const Executor& executor, const BodyPositions& bodies, const Subdomain& subdomain, int64_t ranks,
                    const LeavingRows& leaving) {
  require_owners(executor, subdomain, ranks);
  int64_t found = 0;
  find_rows(executor, bodies.count, leaving.rows, &found,
            [&](int64_t body) { return is_leaving(subdomain, bodies, body); });
  const auto destination = [&](int64_t k) { return owner_of(subdomain, bodies, leaving.rows[k]); };
  std::fill_n(leaving.counts, ranks, int64_t{0});
  for (int64_t k = 0; k < found; ++k) ++leaving.counts[destination(k)];
  std::vector<int64_t> next(static_cast<size_t>(ranks));
  std::exclusive_scan(leaving.counts, leaving.counts + ranks, next.begin(), int64_t{0});
  for (int64_t k = 0; k < found; ++k) {
    leaving.by_destination[next[static_cast<size_t>(destination(k))]++] = leaving.rows[k];
  }
}

void leaving_and_invalid(const Executor&, const BodyPositions& bodies, const Subdomain& subdomain, int64_t* counts) {
  counts[0] = counts[1] = 0;
  for (int64_t body = 0; body < bodies.count; ++body) {
    counts[0] += is_leaving(subdomain, bodies, body) ? 1 : 0;
    counts[1] += has_invalid_position(bodies, body) ? 1 : 0;
  }
}

}  // namespace pgccd
