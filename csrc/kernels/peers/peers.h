// Small messages between GPUs of one host: a kernel writes its message into the memory of the other GPUs, sets a flag
// there, and waits for the others' flags. Takes 4 us, a call of NCCL in a CUDA graph 16 us.
//
// If another rank is lost, this waiting would last forever. A word in host memory ends it: the rank gives up the
// message, and then sends nothing, since its values may depend on that message.
#pragma once

#include <cstdint>

#include "kernels/device_context.h"

namespace pgccd {

constexpr int kMostPeers = 16;
// Blocks per pair of ranks; each sends and receives one part of every message.
constexpr int kPeerBlocks = 8;
constexpr int64_t kFlagBytes = 256;

// The memory of all ranks for messages, zero before the first one. That of each rank has one region per source:
// kFlagBytes of flags (see PeerRegion), then two slots for messages, used alternately. In the region for itself, the
// first word says whether the rank has given up a message.
//
// Two slots suffice: message n + 2 is written after message n + 1 of its receiver has arrived, which that rank sent
// after reading message n.
struct PeerMemory {
  const int64_t* addresses;  // (ranks,) of each rank's memory, in this process
  const int64_t* stop;       // in host memory; nonzero: gives up messages that have not arrived
  int64_t rank, ranks;
  int64_t region_bytes;

  int64_t slot_bytes() const { return (region_bytes - kFlagBytes) / 2 / 8 * 8; }
};

// Values (count,) of this rank -> gathered (ranks, count). Values that do not arrive because of `stop` are 1, so that
// flags of failure are set.
struct PeerGather {
  const int64_t* values;
  int64_t count;
  int64_t* gathered;
};

// Rows sent to each rank, or received from it: `rows`, ordered by rank, -1 for padding; begin[rank] is the first one
// for a rank.
struct PeerRows {
  const int64_t* rows;
  int64_t begin[kMostPeers + 1];
};

// Lowers values (count,) >= 0: sends the rows `sent` to each rank, and lowers the rows `received` to what arrives.
struct PeerMinimum {
  double* values;
  int64_t count;
  PeerRows sent, received;
  const int64_t* found = nullptr;  // (1,), sent too; or null
  int64_t* anywhere = nullptr;     // (1,) set to 1 if `found` of any rank is nonzero
};

// All ranks make the same calls, each on one stream. They do not synchronise.
void peer_gather(const DeviceContext& context, const PeerMemory& memory, const PeerGather& message);
void peer_minimum(const DeviceContext& context, const PeerMemory& memory, const PeerMinimum& message);

}  // namespace pgccd
