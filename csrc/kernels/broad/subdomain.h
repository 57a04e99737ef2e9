// Ranks whose cells the sweeps of bodies reach: for distributing bodies over ranks.
#pragma once

#include <vector>

#include "kernels/broad/subdomain_item.h"
#include "kernels/executor.h"

namespace pgccd {

// `rows` is as long as the input; the rows found come first, in ascending order. `found` is their number.
struct FoundRows {
  int64_t* rows;
  int64_t* found;
};

// Bodies that reach cells of other ranks, and rows of -1 after them. reach (count,): 1 for them, or 0.
void boundary_bodies_cpu(const Executor& executor, const BroadBodies& bodies, const Subdomain& subdomain,
                         uint8_t* reach, const FoundRows& boundary);

// Bodies whose replica ranks are wanted: `rows` (row_count,), -1 for padding. If `received` is not empty, they are
// ghosts in the order of the ranks they came from, so many from each (with padding), which are replica ranks of them
// too.
struct ReplicaRanksInput {
  BroadBodies bodies;
  Subdomain subdomain;
  const int64_t* rows;
  int64_t row_count;
  const std::vector<int64_t>& received;
};

// replica_ranks (row_count, ranks): 1 for other ranks that hold the body, or 0; counts (ranks,): bodies of each rank.
struct ReplicaRanks {
  int64_t ranks;
  uint8_t* replica_ranks;
  int64_t* counts;
};

void replica_ranks_cpu(const Executor& executor, const ReplicaRanksInput& input, const ReplicaRanks& out);

// Bodies, and the other ranks whose parts they reach: how many there are of each (row_count,), some counted several
// times; or, where it is known at which place those of each row begin, the ranks.
struct ReachedRanks {
  BroadBodies bodies;
  Subdomain subdomain;
  const int64_t* rows;
  int64_t row_count;
  const int64_t* begin;  // (row_count,); null: they are counted
  int64_t places;        // for the ranks of all rows
  int64_t ranks;

  // Sets the k-th count, or its ranks. False: there is no place for them.
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

void reached_ranks_cpu(const Executor& executor, const ReachedRanks& input, int64_t* out);

// Rows and their replica ranks as above.
struct HeldRows {
  const uint8_t* replica_ranks;
  const int64_t* rows;
  int64_t row_count, ranks;
  const int64_t* counts;
};

// The rows that rank 0 holds, then those of rank 1, and so on, each padded to the capacity of its rank with
// -1. Rows beyond the capacity are dropped.
void rows_by_rank_cpu(const HeldRows& held, const std::vector<int64_t>& capacities, int64_t* by_rank);

// Whether all rows fit.
struct CapacityInput {
  const int64_t* counts;  // (ranks,) of rows for each rank
  const int64_t* found;   // (1,) rows in all
  int64_t capacity;       // of all rows together

  // `capacities`: of each rank.
  PGCCD_HD bool is_short(const int64_t* capacities, int64_t ranks) const {
    for (int64_t rank = 0; rank < ranks; ++rank) {
      if (counts[rank] > capacities[rank]) return true;
    }
    return *found > capacity;
  }
};

// messages (ranks, 2): the count of each rank, and 1 if rows were dropped anywhere.
void counts_to_send_cpu(const CapacityInput& input, const std::vector<int64_t>& capacities, int64_t* messages);

// Pairs whose reference point lies in a cell of the subdomain's rank, in the first places of owned (pair_count, 2),
// then pairs of -1; `found` is how many there are.
void owned_pairs_cpu(const Executor& executor, const OwnedPairs& input, int64_t* owned, int64_t* found);

// Bodies that overlap the box around all ghosts in a cell of the subdomain's rank which they reach.
void near_ghosts_cpu(const Executor& executor, const BroadBodies& bodies, const BroadBodies& ghosts,
                     const Subdomain& subdomain, const FoundRows& near);

struct LeavingRows {
  int64_t* rows;            // as long as the input; those found come first, ascending
  int64_t* by_destination;  // the same rows, those to each rank together
  int64_t* counts;          // (ranks,) how many to each
};

// Bodies whose centre lies in a cell of another rank.
void leaving_bodies_cpu(const Executor& executor, const BodyPositions& bodies, const Subdomain& subdomain,
                        int64_t ranks, const LeavingRows& leaving);

}  // namespace pgccd
