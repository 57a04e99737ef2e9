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
  void reached_ranks(const BroadBodies& bodies, const Territory& territory, const int64_t* rows, int64_t row_count,
                     int64_t ranks, uint8_t* reached) const {
    reached_ranks_cpu(executor_, bodies, territory, rows, row_count, ranks, reached);
  }
  void owned_pairs(const OwnedPairs& input, int64_t pair_count, const FoundRows& owned) const {
    owned_pairs_cpu(executor_, input, pair_count, owned);
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
