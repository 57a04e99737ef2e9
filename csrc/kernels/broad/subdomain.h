// Distribution of bodies over ranks: the boxes of swept spheres, and the ranks whose parts of space these reach.
#pragma once

#include <vector>

#include "kernels/broad/subdomain_item.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

// lower and upper (count, 3): the box of every CBV grown by half of separation and tolerance. Boxes of potentially
// colliding pairs overlap (closed, as rounded), since rounding is monotone.
void swept_boxes(const Executor& executor, const BroadBodies& bodies, double* lower, double* upper);
void swept_boxes(const DeviceContext& context, const BroadBodies& bodies, double* lower, double* upper);

// `rows` has the length of the input; the rows found come first, in ascending order. `found` is their number.
struct FoundRows {
  int64_t* rows;
  int64_t* found;
};

// Finds bodies that reach cells of other ranks; the remaining rows are -1. reach (count,): 1 for these bodies, else 0.
void boundary_bodies(const Executor& executor, const BroadBodies& bodies, const Subdomain& subdomain, uint8_t* reach,
                     const FoundRows& boundary);
void boundary_bodies(const DeviceContext& context, const BroadBodies& bodies, const Subdomain& subdomain,
                     uint8_t* reach, const FoundRows& boundary);

// Bodies whose replica ranks are computed: `rows` (row_count,), -1 for padding. If `received` is not empty, they are
// ghosts ordered by source rank, with this number from each (padding included); the source is a replica rank too.
struct ReplicaRanksInput {
  BroadBodies bodies;
  Subdomain subdomain;
  const int64_t* rows;
  int64_t row_count;
  const std::vector<int64_t>& received;
};

// replica_ranks (row_count, ranks): 1 for other ranks that hold the body, else 0; counts (ranks,): number of bodies per
// rank.
struct ReplicaRanks {
  int64_t ranks;
  uint8_t* replica_ranks;
  int64_t* counts;
};

void replica_ranks(const Executor& executor, const ReplicaRanksInput& input, const ReplicaRanks& out);
void replica_ranks(const DeviceContext& context, const ReplicaRanksInput& input, const ReplicaRanks& out);

// Bodies, and the other ranks whose parts they reach: the number of ranks of each (row_count,), with repetitions; or,
// given the first index of each row, the ranks.
struct ReachedRanks {
  BroadBodies bodies;
  Subdomain subdomain;
  const int64_t* rows;
  int64_t row_count;
  const int64_t* begin;  // (row_count,); null to count
  int64_t places;        // total number of ranks of all rows
  int64_t ranks;

  // Stores the k-th count, or its ranks. False if they do not fit.
  PGCCD_HD bool store(int64_t k, int64_t* out) const {
    const int64_t count = store_reached(bodies, subdomain, rows[k], nullptr);
    if (begin == nullptr) {
      out[k] = count;
      return true;
    }
    if (begin[k] < 0 || begin[k] > places - count) return false;
    store_reached(bodies, subdomain, rows[k], out + begin[k]);
    return true;
  }
};

void reached_ranks(const Executor& executor, const ReachedRanks& input, int64_t* out);
void reached_ranks(const DeviceContext& context, const ReachedRanks& input, int64_t* out);

// Rows and their replica ranks as above.
struct HeldRows {
  const uint8_t* replica_ranks;
  const int64_t* rows;
  int64_t row_count, ranks;
  const int64_t* counts;
};

// The rows that rank 0 holds, then those of rank 1, ..., each padded with -1 to the capacity of the rank. Rows beyond
// the capacity are dropped.
void rows_by_rank(const Executor& executor, const HeldRows& held, const std::vector<int64_t>& capacities,
                  int64_t* by_rank);
void rows_by_rank(const DeviceContext& context, const HeldRows& held, const std::vector<int64_t>& capacities,
                  int64_t* by_rank);

// Test whether all rows fit.
struct CapacityInput {
  const int64_t* counts;  // (ranks,) number of rows for each rank
  const int64_t* found;   // (1,) total number of rows
  int64_t capacity;       // of the total

  // `capacities`: of each rank.
  PGCCD_HD bool is_short(const int64_t* capacities, int64_t ranks) const {
    for (int64_t rank = 0; rank < ranks; ++rank) {
      if (counts[rank] > capacities[rank]) return true;
    }
    return *found > capacity;
  }
};

// messages (ranks, 2): the count for each rank, and 1 if any rows were dropped.
void counts_to_send(const Executor& executor, const CapacityInput& input, const std::vector<int64_t>& capacities,
                    int64_t* messages);
void counts_to_send(const DeviceContext& context, const CapacityInput& input, const std::vector<int64_t>& capacities,
                    int64_t* messages);

// Selects pairs whose reference point is in a cell of the subdomain's rank, except pairs of two own bodies of which one
// reaches no other rank: owned (pair_count, 2), padded with -1; `found` is their number.
void owned_pairs(const Executor& executor, const OwnedPairs& input, int64_t* owned, int64_t* found);
void owned_pairs(const DeviceContext& context, const OwnedPairs& input, int64_t* owned, int64_t* found);

// Finds bodies that overlap the box around all ghosts in a cell of the subdomain's rank that they reach, or that reach
// cells of other ranks themselves: reach (count,) as of boundary_bodies.
void near_ghosts(const Executor& executor, const BroadBodies& bodies, const uint8_t* reach, const BroadBodies& ghosts,
                 const Subdomain& subdomain, const FoundRows& near);
void near_ghosts(const DeviceContext& context, const BroadBodies& bodies, const uint8_t* reach,
                 const BroadBodies& ghosts, const Subdomain& subdomain, const FoundRows& near);

struct LeavingRows {
  int64_t* rows;            // as long as the input; rows found come first, ascending
  int64_t* by_destination;  // the same rows, grouped by destination rank
  int64_t* counts;          // (ranks,) number of rows per destination
};

// Finds bodies whose position is in a cell of another rank.
void leaving_bodies(const Executor& executor, const BodyPositions& bodies, const Subdomain& subdomain, int64_t ranks,
                    const LeavingRows& leaving);
void leaving_bodies(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                    int64_t ranks, const LeavingRows& leaving);

// counts (2,): numbers of leaving bodies, and of bodies whose position is invalid.
void leaving_and_invalid(const Executor& executor, const BodyPositions& bodies, const Subdomain& subdomain,
                         int64_t* counts);
void leaving_and_invalid(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                         int64_t* counts);

}  // namespace pgccd
