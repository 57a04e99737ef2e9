// How the broad phases on the device collect the pairs they find, in any number, and put them in order.
#pragma once

#include <cub/cub.cuh>

#include "kernels/broad/broad_cuda.h"
#include "kernels/device.cuh"

namespace pgccd {

// Pairs as i * 2^32 + j. What does not fit is counted all the same.
struct PairList {
  unsigned long long* count;
  uint64_t* pairs;
  int64_t capacity;

  __device__ void append(int64_t i, int64_t j) const {
    const unsigned long long at = atomicAdd(count, 1ull);
    if (static_cast<int64_t>(at) < capacity) pairs[at] = (static_cast<uint64_t>(i) << 32) | static_cast<uint64_t>(j);
  }
};

inline int bit_width(int64_t count) {
  int bits = 1;
  while ((count >> bits) != 0) ++bits;
  return bits;
}

// Rows (i, j) of the pairs, sorted by i, then j.
inline void write_sorted(const DeviceContext& context, const uint64_t* pairs, int64_t count, int64_t body_count,
                         int64_t* out) {
  if (count == 0) return;
  uint64_t* sorted = context.allocate<uint64_t>(count);
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortKeys(scratch, bytes, pairs, sorted, count, 0, 32 + bit_width(body_count),
                                          context.stream);
  });
  for_each_item(context, count, [=] __device__(int64_t row) {
    out[2 * row] = static_cast<int64_t>(sorted[row] >> 32);
    out[2 * row + 1] = static_cast<int64_t>(sorted[row] & 0xffffffffu);
  });
}

// Runs `launch` with a list that it fills; once more, with enough room, if the first guess was too small. Waits once
// (or twice) for the number of pairs, which the output's size depends on.
template <class Launch>
void collect_pairs(const DeviceContext& context, int64_t body_count, const PairOutput& make_output, Launch&& launch) {
  auto* counter = context.allocate<unsigned long long>(1);
  for (int64_t capacity = 4 * body_count + 1024;;) {
    uint64_t* found = context.allocate<uint64_t>(capacity);
    fill_bytes(context, counter, 0, 1);
    launch(PairList{counter, found, capacity});
    check_cuda(cudaGetLastError(), "broad phase");
    const int64_t count = static_cast<int64_t>(read(context, counter));
    if (count <= capacity) return write_sorted(context, found, count, body_count, make_output(count));
    capacity = count;
  }
}

}  // namespace pgccd
