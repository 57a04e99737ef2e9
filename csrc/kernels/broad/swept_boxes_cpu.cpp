#include "kernels/broad/swept_boxes.h"
#include "kernels/broad/swept_boxes_item.h"

namespace pgccd {

void swept_boxes_cpu(const Executor& executor, const BroadBodies& bodies, double* lower, double* upper) {
  parallel_chunks(executor, bodies.count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) store_swept_box(bodies, body, lower, upper);
  });
}

}  // namespace pgccd
