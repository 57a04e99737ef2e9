// Rows that fulfil a condition, in order, with their number on the device.
#pragma once

#include <thrust/iterator/counting_iterator.h>

#include <cub/cub.cuh>

#include "kernels/launch.cuh"

namespace pgccd {

// The rows with a nonzero flag (count,): rows (count,) begins with them; found (1,) is their number.
inline void find_flagged(const DeviceContext& context, int64_t count, const uint8_t* flags, int64_t* rows,
                         int64_t* found) {
  if (count == 0) return fill_bytes(context, found, 0, 1);
  const thrust::counting_iterator<int64_t> everything(0);
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceSelect::Flagged(scratch, bytes, everything, flags, rows, found, count, context.stream);
  });
}

namespace device_detail {

template <class IsWanted>
struct MarkWanted {
  IsWanted is_wanted;
  uint8_t* wanted;
  __device__ void operator()(int64_t row) const { wanted[row] = is_wanted(row) ? 1 : 0; }
};

}  // namespace device_detail

// As `find_flagged`, for a condition. It is evaluated first: a thread of the selection has ten rows or more, one after
// another.
template <class IsWanted>
void find_rows(const DeviceContext& context, int64_t count, int64_t* rows, int64_t* found, const IsWanted& is_wanted) {
  uint8_t* wanted = context.allocate<uint8_t>(count);
  for_each_item(context, count, device_detail::MarkWanted<IsWanted>{is_wanted, wanted});
  find_flagged(context, count, wanted, rows, found);
}

}  // namespace pgccd
