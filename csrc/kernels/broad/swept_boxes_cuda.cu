#include "kernels/broad/swept_boxes_cuda.h"
#include "kernels/broad/swept_boxes_item.h"
#include "kernels/launch.cuh"

namespace pgccd {

void swept_boxes_cuda(const DeviceContext& context, const BroadBodies& bodies, double* lower, double* upper) {
  for_each_item(context, bodies.count, [=] __device__(int64_t body) { store_swept_box(bodies, body, lower, upper); });
}

}  // namespace pgccd
