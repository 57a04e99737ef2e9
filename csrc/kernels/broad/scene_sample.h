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

// Calls look(box) for the swept boxes of the sample, or for one share in `shares`.
template <class Look>
PGCCD_HD void for_each_sampled(const BroadBodies& bodies, Look&& look, int64_t share = 0, int64_t shares = 1) {
  const int64_t stride = sample_stride(bodies.count);
  for (int64_t b = share * stride; b < bodies.count; b += shares * stride) {
    if (!bodies.is_absent(b)) look(swept_box(bodies, b));
  }
}

// The sample, visited by one thread. BlockSample has the same functions.
struct ThreadSample {
  template <class Look>
  void for_each(const BroadBodies& bodies, Look&& look) const {
    for_each_sampled(bodies, look);
  }
  template <int kCount>
  void sum(double (&)[kCount]) const {}
  template <int kCount>
  void maximum(double (&)[kCount]) const {}
};

PGCCD_HD Vec3<double> middle_of(const SweptBox& box) { return 0.5 * box.lower + 0.5 * box.upper; }

}  // namespace pgccd
