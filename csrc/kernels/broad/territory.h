// Whose cells bodies reach, for those who share bodies out among ranks by where they may go.
#pragma once

#include "kernels/broad/territory_item.h"
#include "kernels/executor.h"

namespace pgccd {

// `rows` has room for all; the rows found ascend. `found` is their number.
struct FoundRows {
  int64_t* rows;
  int64_t* found;
};

// Bodies that reach cells of other ranks. reach (count,): kReachesOthers or 0.
void border_bodies_cpu(const Executor& executor, const BroadBodies& bodies, const Territory& territory, uint8_t* reach,
                       const FoundRows& border);

// Which ranks' cells each of the bodies `rows` (row_count,) reaches; reached (row_count, ranks) 0 or 1.
void reached_ranks_cpu(const Executor& executor, const BroadBodies& bodies, const Territory& territory,
                       const int64_t* rows, int64_t row_count, int64_t ranks, uint8_t* reached);

// Pairs whose reference point lies in a cell of the territory's rank; if asked for, only those with a ghost.
void owned_pairs_cpu(const Executor& executor, const OwnedPairs& input, int64_t pair_count, const FoundRows& owned);

// Bodies that overlap the box around all ghosts in a cell of the territory's rank which they reach.
void near_ghosts_cpu(const Executor& executor, const BroadBodies& bodies, const BroadBodies& ghosts,
                     const Territory& territory, const FoundRows& near);

struct LeavingRows {
  int64_t* rows;            // room for all; ascending
  int64_t* by_destination;  // the same rows, those to each rank together
  int64_t* counts;          // (ranks,) how many to each
};

// Bodies whose centre (count, 3) lies in a cell of another rank.
void leaving_bodies_cpu(const Executor& executor, const double* position, int64_t count, const Territory& territory,
                        int64_t ranks, const LeavingRows& leaving);

}  // namespace pgccd
