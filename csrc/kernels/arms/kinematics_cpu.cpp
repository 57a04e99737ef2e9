#include "kernels/arms/kinematics.h"

#include "kernels/arms/kinematics_item.h"

namespace pgccd {
namespace {

constexpr int64_t kGrain = 64;

}  // namespace

void arm_poses(const Executor& executor, const Arm& arm, const double* q, int64_t count, const ArmPoses& out) {
  parallel_chunks(executor, count * arm.body_count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const double* const own = q + row / arm.body_count * arm.coordinate_count;
      const ArmArc arc = arc_of_body(arm, {own, own, 0.0, 0.0}, row % arm.body_count, kWorld);
      store_vec3(out.position + 3 * row, arc.start.position);
      out.orientation[4 * row] = arc.start.orientation.w;
      store_vec3(out.orientation + 4 * row + 1, arc.start.orientation.v);
    }
  });
}

void arm_strays(const Executor& executor, const Arm& arm, const double* q0, const double* q1, int64_t count,
                double* stray) {
  parallel_chunks(executor, count * arm.body_count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t first = row / arm.body_count * arm.coordinate_count;
      stray[row] = arc_of_body(arm, {q0 + first, q1 + first, 0.0, 1.0}, row % arm.body_count, kWorld).stray;
    }
  });
}

}  // namespace pgccd
