#include <stdexcept>

#include "kernels/bounds/validation.h"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

struct Columns {
  RowColumn column[kMostColumns];
  int count;
};

__global__ void __launch_bounds__(kBlockThreads) find_invalid_rows(Columns columns, double* sound, int64_t* first) {
  wait_for_previous_kernels();
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int c = 0; c < columns.count; ++c) {
    const RowColumn& column = columns.column[c];
    for (int64_t row = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; row < column.rows; row += stride) {
      if (!is_invalid(column, row)) continue;
      atomicMin(reinterpret_cast<unsigned long long*>(first) + c, static_cast<unsigned long long>(row));
      first[columns.count] = 1;
      if (sound != nullptr) sound[row] = -INFINITY;
    }
  }
}

}  // namespace

void first_invalid_rows(const DeviceContext& context, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first) {
  if (columns.size() > kMostColumns) throw std::runtime_error("first_invalid_rows: too many columns");
  Columns all{};
  all.count = static_cast<int>(columns.size());
  int64_t most = 0;
  for (int c = 0; c < all.count; ++c) {
    all.column[c] = columns[c];
    most = larger(most, columns[c].rows);
  }
  for_each_item(context, larger<int64_t>(all.count + 1, radii.count), [=] __device__(int64_t k) {
    if (k <= all.count) first[k] = k < all.count ? all.column[k].rows : 0;
    if (k < radii.count) radii.out[k] = radius_of(radii, k);
  });
  if (most == 0) return;
  launch_kernel(context, find_invalid_rows, looping_blocks_for(context, most), kBlockThreads, all, radii.out, first);
}

}  // namespace pgccd
