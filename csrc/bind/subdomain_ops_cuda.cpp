// Ranks whose parts of space bodies reach, on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/cuda_backend.h"
#include "bind/subdomain_ops.h"
#include "kernels/broad/subdomain_cuda.h"

namespace pgccd::bind {
namespace {

class SubdomainOnCuda {
 public:
  explicit SubdomainOnCuda(const Tensor& like) : session_(like) {}

  void boundary_bodies(const BroadBodies& bodies, const Subdomain& subdomain, uint8_t* reach,
                       const FoundRows& boundary) const {
    boundary_bodies_cuda(session_.context(), bodies, subdomain, reach, boundary);
  }
  void replica_ranks(const ReplicaRanksInput& input, const ReplicaRanks& out) const {
    replica_ranks_cuda(session_.context(), input, out);
  }
  void reached_ranks(const ReachedRanks& input, int64_t* out) const {
    reached_ranks_cuda(session_.context(), input, out);
  }
  void rows_by_rank(const HeldRows& held, const std::vector<int64_t>& capacities, int64_t* by_rank) const {
    rows_by_rank_cuda(session_.context(), held, capacities, by_rank);
  }
  void counts_to_send(const CapacityInput& input, const std::vector<int64_t>& capacities, int64_t* messages) const {
    counts_to_send_cuda(session_.context(), input, capacities, messages);
  }
  void owned_pairs(const OwnedPairs& input, int64_t* owned, int64_t* found) const {
    owned_pairs_cuda(session_.context(), input, owned, found);
  }
  void near_ghosts(const BroadBodies& bodies, const uint8_t* reach, const BroadBodies& ghosts,
                   const Subdomain& subdomain, const FoundRows& near) const {
    near_ghosts_cuda(session_.context(), bodies, reach, ghosts, subdomain, near);
  }
  void leaving_bodies(const BodyPositions& bodies, const Subdomain& subdomain, int64_t ranks,
                      const LeavingRows& leaving) const {
    leaving_bodies_cuda(session_.context(), bodies, subdomain, ranks, leaving);
  }
  void count_leaving(const BodyPositions& bodies, const Subdomain& subdomain, int64_t* count) const {
    count_leaving_cuda(session_.context(), bodies, subdomain, count);
  }

 private:
  CudaSession session_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) { PGCCD_REGISTER_SUBDOMAIN_OPS(library, SubdomainOnCuda); }

}  // namespace pgccd::bind

#endif
