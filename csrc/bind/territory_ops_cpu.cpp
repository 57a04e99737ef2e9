// Whose cells bodies reach, on the CPU.
#include "bind/cpu_executor.h"
#include "bind/territory_ops.h"

namespace pgccd::bind {
namespace {

class TerritoryOnCpu {
 public:
  explicit TerritoryOnCpu(const Tensor&) {}

  void border_bodies(const BroadBodies& bodies, const Territory& territory, uint8_t* reach,
                     const FoundRows& border) const {
    border_bodies_cpu(executor_, bodies, territory, reach, border);
  }
  void holders_of(const HoldersInput& input, const Holders& out) const { holders_of_cpu(executor_, input, out); }
  void rows_by_rank(const HeldRows& held, const std::vector<int64_t>& rooms, int64_t* by_rank) const {
    rows_by_rank_cpu(held, rooms, by_rank);
  }
  void counts_to_tell(const RoomInput& input, const std::vector<int64_t>& rooms, int64_t* told) const {
    counts_to_tell_cpu(input, rooms, told);
  }
  void owned_pairs(const OwnedPairs& input, int64_t* owned, int64_t* found) const {
    owned_pairs_cpu(executor_, input, owned, found);
  }
  void near_ghosts(const BroadBodies& bodies, const BroadBodies& ghosts, const Territory& territory,
                   const FoundRows& near) const {
    near_ghosts_cpu(executor_, bodies, ghosts, territory, near);
  }
  void leaving_bodies(const double* position, int64_t count, const Territory& territory, int64_t ranks,
                      const LeavingRows& leaving) const {
    leaving_bodies_cpu(executor_, position, count, territory, ranks, leaving);
  }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) { PGCCD_REGISTER_TERRITORY_OPS(library, TerritoryOnCpu); }

}  // namespace pgccd::bind
