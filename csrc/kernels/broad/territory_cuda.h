// Whose cells bodies reach, on the device: contracts as in territory.h.
#pragma once

#include "kernels/broad/territory.h"
#include "kernels/device_context.h"

namespace pgccd {

void border_bodies_cuda(const DeviceContext& context, const BroadBodies& bodies, const Territory& territory,
                        uint8_t* reach, const FoundRows& border);

void reached_ranks_cuda(const DeviceContext& context, const BroadBodies& bodies, const Territory& territory,
                        const int64_t* rows, int64_t row_count, int64_t ranks, uint8_t* reached);

void owned_pairs_cuda(const DeviceContext& context, const OwnedPairs& input, int64_t pair_count,
                      const FoundRows& owned);

void near_ghosts_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadBodies& ghosts,
                      const Territory& territory, const FoundRows& near);

void leaving_bodies_cuda(const DeviceContext& context, const double* position, int64_t count,
                         const Territory& territory, int64_t ranks, const LeavingRows& leaving);

}  // namespace pgccd
