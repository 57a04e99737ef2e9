// Whose cells bodies reach, on the device: contracts as in territory.h.
#pragma once

#include "kernels/broad/territory.h"
#include "kernels/device_context.h"

namespace pgccd {

void border_bodies_cuda(const DeviceContext& context, const BroadBodies& bodies, const Territory& territory,
                        uint8_t* reach, const FoundRows& border);

void holders_of_cuda(const DeviceContext& context, const HoldersInput& input, const Holders& out);

void rows_by_rank_cuda(const DeviceContext& context, const HeldRows& held, const std::vector<int64_t>& rooms,
                       int64_t* by_rank);

void counts_to_tell_cuda(const DeviceContext& context, const RoomInput& input, const std::vector<int64_t>& rooms,
                         int64_t* told);

void owned_pairs_cuda(const DeviceContext& context, const OwnedPairs& input, int64_t* owned, int64_t* found);

void near_ghosts_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadBodies& ghosts,
                      const Territory& territory, const FoundRows& near);

void leaving_bodies_cuda(const DeviceContext& context, const double* position, int64_t count,
                         const Territory& territory, int64_t ranks, const LeavingRows& leaving);

}  // namespace pgccd
