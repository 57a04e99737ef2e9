// Small messages between GPUs. All ranks make the same calls, each on one stream. Do not synchronise.
#pragma once

#include "kernels/device_context.h"
#include "kernels/peers/peers.h"

namespace pgccd {

void peer_gather_cuda(const DeviceContext& context, const PeerMemory& memory, const PeerGather& message);

void peer_minimum_cuda(const DeviceContext& context, const PeerMemory& memory, const PeerMinimum& message);

}  // namespace pgccd
