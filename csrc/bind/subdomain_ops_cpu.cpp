// Ranks whose parts of space bodies reach, on the CPU.
#include "bind/cpu_executor.h"
#include "bind/subdomain_ops.h"

namespace pgccd::bind {
namespace {

class SubdomainOnCpu {
 public:
  explicit SubdomainOnCpu(const Tensor&) {}

  void boundary_bodies(const BroadBodies& bodies, const Subdomain& subdomain, uint8_t* reach,
                       const FoundRows& boundary) const {
    boundary_bodies_cpu(executor_, bodies, subdomain, reach, boundary);
  }
  void replica_ranks(const ReplicaRanksInput& input, const ReplicaRanks& out) const {
    replica_ranks_cpu(executor_, input, out);
  }
  void reached_ranks(const ReachedRanks& input, int64_t* out) const { reached_ranks_cpu(executor_, input, out); }
  void rows_by_rank(const HeldRows& held, const std::vector<int64_t>& capacities, int64_t* by_rank) const {
    rows_by_rank_cpu(held, capacities, by_rank);
  }
  void counts_to_send(const CapacityInput& input, const std::vector<int64_t>& capacities, int64_t* messages) const {
    counts_to_send_cpu(input, capacities, messages);
  }
  void owned_pairs(const OwnedPairs& input, int64_t* owned, int64_t* found) const {
    owned_pairs_cpu(executor_, input, owned, found);
  }
  void near_ghosts(const BroadBodies& bodies, const uint8_t* reach, const BroadBodies& ghosts,
                   const Subdomain& subdomain, const FoundRows& near) const {
    near_ghosts_cpu(executor_, bodies, reach, ghosts, subdomain, near);
  }
  void leaving_bodies(const BodyPositions& bodies, const Subdomain& subdomain, int64_t ranks,
                      const LeavingRows& leaving) const {
    leaving_bodies_cpu(executor_, bodies, subdomain, ranks, leaving);
  }
  void count_leaving(const BodyPositions& bodies, const Subdomain& subdomain, int64_t* count) const {
    count_leaving_cpu(bodies, subdomain, count);
  }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) { PGCCD_REGISTER_SUBDOMAIN_OPS(library, SubdomainOnCpu); }

}  // namespace pgccd::bind
