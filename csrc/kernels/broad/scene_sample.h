// A sample of the bodies, for choices of broad phases that affect their time but not their result.
#pragma once

#include "kernels/broad/body_volumes.h"

namespace pgccd {

constexpr int64_t kSceneSample = 1024;

// Stride of the sample: it contains every body whose index is a multiple.
PGCCD_HD int64_t sample_stride(int64_t body_count) { return larger<int64_t>(1, body_count / kSceneSample); }
// Weight of each sampled body in a mean.
PGCCD_HD double sample_weight(int64_t body_count) {
  const int64_t stride = sample_stride(body_count);
  return 1.0 / static_cast<double>((body_count + stride - 1) / stride);
}

PGCCD_HD Vec3<double> middle_of(const SweptBox& box) { return 0.5 * box.lower + 0.5 * box.upper; }

}  // namespace pgccd
