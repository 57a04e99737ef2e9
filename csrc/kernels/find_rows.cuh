// Rows that fulfil a condition, in order, with their number on the device.
#pragma once

#include <thrust/iterator/counting_iterator.h>

#include <cub/cub.cuh>

#include "kernels/launch.cuh"

namespace pgccd {

// rows (count,): the rows found come first; found (1,) is their number.
template <class IsWanted>
void find_rows(const DeviceContext& context, int64_t count, int64_t* rows, int64_t* found, const IsWanted& is_wanted) {
  if (count == 0) return fill_bytes(context, found, 0, 1);
  const thrust::counting_iterator<int64_t> everything(0);
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceSelect::If(scratch, bytes, everything, rows, found, count, is_wanted, context.stream);
  });
}

}  // namespace pgccd
