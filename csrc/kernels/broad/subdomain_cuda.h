// Ranks whose parts of space bodies reach, on the device: contracts as in subdomain.h.
#pragma once

#include "kernels/broad/subdomain.h"
#include "kernels/device_context.h"

namespace pgccd {

void boundary_bodies_cuda(const DeviceContext& context, const BroadBodies& bodies, const Subdomain& subdomain,
                          uint8_t* reach, const FoundRows& boundary);

void replica_ranks_cuda(const DeviceContext& context, const ReplicaRanksInput& input, const ReplicaRanks& out);

void reached_ranks_cuda(const DeviceContext& context, const ReachedRanks& input, int64_t* out);
void rows_by_rank_cuda(const DeviceContext& context, const HeldRows& held, const std::vector<int64_t>& capacities,
                       int64_t* by_rank);

void counts_to_send_cuda(const DeviceContext& context, const CapacityInput& input,
                         const std::vector<int64_t>& capacities, int64_t* messages);

void owned_pairs_cuda(const DeviceContext& context, const OwnedPairs& input, int64_t* owned, int64_t* found);

void near_ghosts_cuda(const DeviceContext& context, const BroadBodies& bodies, const uint8_t* reach,
                      const BroadBodies& ghosts, const Subdomain& subdomain, const FoundRows& near);

void leaving_bodies_cuda(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                         int64_t ranks, const LeavingRows& leaving);

void count_leaving_cuda(const DeviceContext& context, const BodyPositions& bodies, const Subdomain& subdomain,
                        int64_t* count);

}  // namespace pgccd
