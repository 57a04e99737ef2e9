// Collection, test and sort of pairs in the broad phases on the device.
#pragma once

#include "kernels/broad/broad.h"
#include "kernels/device.cuh"

namespace pgccd {

// Packed pairs. Pairs beyond the capacity are counted.
struct PairList {
  unsigned long long* count;
  uint64_t* pairs;
  int64_t capacity;
  const int64_t* is_invalid = nullptr;  // of the bodies

  // Pairs of invalid bodies are dropped; there could be very many.
  __device__ bool is_wanted() const { return is_invalid == nullptr || *is_invalid == 0; }

  // Threads of a warp that append together share one atomic.
  __device__ void append(uint64_t pair) const {
    const unsigned active = __activemask();
    const unsigned lane = threadIdx.x & 31u;
    const int leader = __ffs(static_cast<int>(active)) - 1;
    unsigned long long base = 0;
    if (lane == static_cast<unsigned>(leader)) base = atomicAdd(count, static_cast<unsigned long long>(__popc(active)));
    base = __shfl_sync(active, base, leader) + __popc(active & ((1u << lane) - 1u));
    if (static_cast<int64_t>(base) < capacity) pairs[base] = pair;
  }
};

// A block's buffer of a list, in shared memory: one atomic on the list for hundreds of pairs.
class PairBuffer {
 public:
  __device__ void clear() {
    if (threadIdx.x == 0) count_ = 0;
    __syncthreads();
  }

  __device__ void append(const PairList& list, uint64_t pair) {
    // A full buffer is not counted further: the count could exceed 2^32.
    const bool is_full = *static_cast<volatile unsigned*>(&count_) >= kCapacity;
    const unsigned at = is_full ? kCapacity : atomicAdd(&count_, 1u);
    if (at < kCapacity) {
      pairs_[at] = pair;
    } else {
      list.append(pair);
    }
  }

  // Moves all pairs to the list and calls moved(position, pair) for each that fits. Called by all threads of the block.
  template <class Moved>
  __device__ void flush(const PairList& list, Moved&& moved) {
    __syncthreads();
    const unsigned size = count_ < kCapacity ? count_ : kCapacity;
    if (threadIdx.x == 0 && size != 0) base_ = atomicAdd(list.count, static_cast<unsigned long long>(size));
    __syncthreads();
    for (unsigned k = threadIdx.x; k < size; k += blockDim.x) {
      const int64_t position = static_cast<int64_t>(base_) + k;
      if (position >= list.capacity) break;
      list.pairs[position] = pairs_[k];
      moved(position, pairs_[k]);
    }
    __syncthreads();
    clear();
  }
  __device__ void flush(const PairList& list) {
    flush(list, [](int64_t, uint64_t) {});
  }

 private:
  static constexpr unsigned kCapacity = 1024;
  uint64_t pairs_[kCapacity];
  unsigned long long base_;
  unsigned count_;
};

// `launch(list)` fills the list with candidates on the stream, each pair at most once; those with
// is_potentially_colliding are written to the output. For an output of exact size this synchronises to read the count,
// and calls `launch` again with enough capacity if the first estimate was too small.
using CandidateLaunch = std::function<void(const PairList& list)>;
void collect_pairs(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out,
                   const CandidateLaunch& launch);

// Records the start time; called before any work.
void note_beginning(const DeviceContext& context, const PairSink& out);

// Writes the output of a scene without pairs.
void write_no_pairs(const DeviceContext& context, const PairSink& out);

}  // namespace pgccd
