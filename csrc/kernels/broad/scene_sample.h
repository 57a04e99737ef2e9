// A sample of the bodies, from which broad phases take what decides how long they take, never what they find.
#pragma once

#include "kernels/broad/body_volumes.h"

namespace pgccd {

constexpr int64_t kSceneSample = 1024;

// The sample holds every body whose index it divides.
PGCCD_HD int64_t sample_stride(int64_t body_count) { return larger<int64_t>(1, body_count / kSceneSample); }
// What each contributes to a mean.
PGCCD_HD double sample_weight(int64_t body_count) {
  const int64_t stride = sample_stride(body_count);
  return 1.0 / static_cast<double>((body_count + stride - 1) / stride);
}

PGCCD_HD Vec3<double> middle_of(const SweptBox& box) { return 0.5 * box.lower + 0.5 * box.upper; }

}  // namespace pgccd
