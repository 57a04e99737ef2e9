#include "kernels/copy_cuda.h"
#include "kernels/device.cuh"

namespace pgccd {

void copy_counts_cuda(const DeviceContext& context, const int64_t* from, int64_t count, int64_t* to) {
  copy(context, from, count, to);
}

}  // namespace pgccd
