#include <cuda/atomic>
#include <limits>

#include "kernels/launch.cuh"
#include "kernels/peers/peers.h"

namespace pgccd {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

// A message of some thousand values is bound by the latency of loads, so a thread has few of them.
constexpr int kPeerThreads = 1024;

// A waiting thread reads `stop`, over PCIe, once in this many turns.
constexpr int kTurnsPerLook = 256;

using Flag = uint64_t;
using SystemFlag = cuda::atomic_ref<Flag, cuda::thread_scope_system>;

// One rank's memory for messages of one source.
struct PeerRegion {
  uint8_t* begin;
  int64_t slot_bytes;

  // Number of the last message of which this part has arrived, for even and odd messages.
  __device__ Flag& arrived(Flag message, int part) const {
    return reinterpret_cast<Flag*>(begin)[(message % 2) * kPeerBlocks + part];
  }
  // Number of messages of which this part has been exchanged, for the rank that has the memory.
  __device__ Flag& exchanged(int part) const { return reinterpret_cast<Flag*>(begin)[2 * kPeerBlocks + part]; }

  template <class T>
  __device__ T* slot(Flag message) const {
    return reinterpret_cast<T*>(begin + kFlagBytes + (message % 2) * slot_bytes);
  }
};
static_assert(3 * kPeerBlocks * sizeof(Flag) <= kFlagBytes);

struct Regions {
  PeerMemory memory;
  int64_t slot_bytes;

  __device__ PeerRegion operator()(int64_t rank, int64_t source) const {
    return {reinterpret_cast<uint8_t*>(memory.addresses[rank]) + source * memory.region_bytes, slot_bytes};
  }

  // Nonzero once this rank has given up a message.
  __device__ SystemFlag has_given_up() const {
    return SystemFlag(*reinterpret_cast<Flag*>((*this)(memory.rank, memory.rank).begin));
  }
};

// Items [begin, end) of the part of a block.
struct PartRange {
  int64_t begin, end;

  __device__ PartRange(int64_t count, int part)
      : begin(count * part / kPeerBlocks), end(count * (part + 1) / kPeerBlocks) {}

  template <class Fn>
  __device__ void for_each(Fn fn) const {
    for (int64_t k = begin + threadIdx.x; k < end; k += blockDim.x) fn(k);
  }
};

// Waits until a flag has a value. Returns false if the rank gives up because of `stop`.
__device__ bool wait_for(const Regions& regions, Flag& flag, Flag value) {
  const SystemFlag arrived(flag);
  for (uint32_t turn = 1; arrived.load(cuda::memory_order_acquire) != value; ++turn) {
    if (turn % kTurnsPerLook != 0 || *const_cast<const volatile int64_t*>(regions.memory.stop) == 0) continue;
    regions.has_given_up().store(1, cuda::memory_order_relaxed);
    return false;
  }
  return true;
}

// Sends one part of a message to a rank, and waits for that part of the rank's message. send(slot) writes to the rank's
// memory, receive(slot) reads from this rank's. Returns false, without receiving, once the rank has given up. Called by
// all threads of the block of this part, once per launch.
template <class T, class Send, class Receive>
__device__ bool exchange_part(const Regions& regions, int64_t peer, int part, Send send, Receive receive) {
  __shared__ Flag message;
  __shared__ bool has_arrived;
  const PeerRegion there = regions(peer, regions.memory.rank), here = regions(regions.memory.rank, peer);
  if (threadIdx.x == 0) {
    const Flag next = here.exchanged(part) + 1;
    const bool has_given_up = regions.has_given_up().load(cuda::memory_order_relaxed) != 0;
    message = has_given_up ? 0 : next;
    if (!has_given_up) here.exchanged(part) = next;
  }
  __syncthreads();
  if (message == 0) return false;
  send(there.slot<T>(message));
  __syncthreads();
  if (threadIdx.x == 0) {
    SystemFlag(there.arrived(message, part)).store(message, cuda::memory_order_release);
    has_arrived = wait_for(regions, here.arrived(message, part), message);
  }
  __syncthreads();
  if (has_arrived) receive(here.slot<T>(message));
  return has_arrived;
}

// gridDim = (kPeerBlocks, ranks), as below.
__global__ void __launch_bounds__(kPeerThreads) gather_from_peers(const Regions regions, const PeerGather given) {
  wait_for_previous_kernels();
  const int64_t peer = blockIdx.y;
  const auto part = static_cast<int>(blockIdx.x);
  const PartRange range(given.count, part);
  int64_t* const out = given.gathered + peer * given.count;
  if (peer == regions.memory.rank) return range.for_each([&](int64_t k) { out[k] = given.values[k]; });
  const bool has_arrived = exchange_part<int64_t>(
      regions, peer, part, [&](int64_t* slot) { range.for_each([&](int64_t k) { slot[k] = given.values[k]; }); },
      [&](const int64_t* slot) { range.for_each([&](int64_t k) { out[k] = slot[k]; }); });
  if (!has_arrived) range.for_each([&](int64_t k) { out[k] = 1; });
}

__device__ void require_row(int64_t row, int64_t count) {
  require_on_device(row >= -1 && row < count, "sent_rows, received_rows: expected -1 or rows of values");
}

// A block may send values that another block has lowered to those of a third rank: the minimum is the same.
__global__ void __launch_bounds__(kPeerThreads)
    lower_to_peers(const Regions regions, const __grid_constant__ PeerMinimum given) {
  wait_for_previous_kernels();
  const int64_t peer = blockIdx.y;
  const auto part = static_cast<int>(blockIdx.x);
  const bool sends_found = given.found != nullptr && part == 0 && threadIdx.x == 0;
  if (peer == regions.memory.rank) {
    if (sends_found && *given.found != 0) *given.anywhere = 1;  // all threads write the same value
    return;
  }
  const int64_t* const sent = given.sent.rows + given.sent.begin[peer];
  const int64_t* const received = given.received.rows + given.received.begin[peer];
  const PartRange of_sent(given.sent.begin[peer + 1] - given.sent.begin[peer], part);
  const PartRange of_received(given.received.begin[peer + 1] - given.received.begin[peer], part);
  exchange_part<double>(
      regions, peer, part,
      [&](double* slot) {
        of_sent.for_each([&](int64_t k) {
          require_row(sent[k], given.count);
          slot[k] = sent[k] < 0 ? kInfinity : given.values[sent[k]];
        });
        if (sends_found) slot[given.sent.begin[peer + 1] - given.sent.begin[peer]] = *given.found != 0 ? 1.0 : 0.0;
      },
      [&](const double* slot) {
        of_received.for_each([&](int64_t k) {
          require_row(received[k], given.count);
          if (received[k] < 0 || !(slot[k] < given.values[received[k]])) return;
          // Non-negative doubles have the same order as their bits.
          atomicMin(reinterpret_cast<long long*>(given.values + received[k]), __double_as_longlong(slot[k]));
        });
        const int64_t last = given.received.begin[peer + 1] - given.received.begin[peer];
        if (sends_found && slot[last] != 0.0) *given.anywhere = 1;
      });
}

dim3 blocks_for(const PeerMemory& memory) { return {kPeerBlocks, static_cast<unsigned>(memory.ranks)}; }

}  // namespace

void peer_gather(const DeviceContext& context, const PeerMemory& memory, const PeerGather& message) {
  launch_kernel(context, gather_from_peers, blocks_for(memory), kPeerThreads, Regions{memory, memory.slot_bytes()},
                message);
}

void peer_minimum(const DeviceContext& context, const PeerMemory& memory, const PeerMinimum& message) {
  launch_kernel(context, lower_to_peers, blocks_for(memory), kPeerThreads, Regions{memory, memory.slot_bytes()},
                message);
}

}  // namespace pgccd
