// Operators that distribute bodies over ranks.
//
// centres, ghosts = [position_t0 (N, 3), position_t1 (N, 3), radius (N,)]
// frame = lower corner, cells per length unit, number of cells; each along x, y, z; owner (cells,) i64, or (planes, 4)
// f64
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def(
      "boundary_bodies(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, int rank) "
      "-> (Tensor reach, "
      "Tensor boundary, Tensor found)");
  library.def(
      "replica_ranks(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, int rank, "
      "Tensor bodies, "
      "int[] received, int ranks) -> (Tensor replica_ranks, Tensor counts)");
  library.def(
      "reached_ranks(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, int rank, "
      "Tensor bodies, Tensor? begin, int places, int ranks) -> Tensor");
  library.def("rows_by_rank(Tensor replica_ranks, Tensor rows, Tensor counts, int[] capacities) -> Tensor");
  library.def("counts_to_send(Tensor counts, int[] capacities, Tensor found, int capacity) -> Tensor");
  library.def(
      "owned_pairs(Tensor pairs, Tensor rows, Tensor id, Tensor[] centres, float min_separation, float tolerance, "
      "Tensor reach, float[] frame, Tensor owner, int rank) -> (Tensor owned, Tensor found)");
  library.def(
      "near_ghosts(Tensor[] centres, Tensor reach, Tensor[] ghosts, float min_separation, float tolerance, "
      "float[] frame, Tensor owner, int rank) -> (Tensor near, Tensor found)");
  library.def(
      "leaving_bodies(Tensor position, float[] frame, Tensor owner, int rank, int ranks) -> (Tensor leaving, Tensor "
      "by_destination, Tensor counts)");
  library.def("count_leaving(Tensor position, Tensor? id, float[] frame, Tensor owner, int rank) -> Tensor");
}
