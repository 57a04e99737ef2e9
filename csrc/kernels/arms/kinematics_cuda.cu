#include "kernels/arms/kinematics.h"
#include "kernels/arms/kinematics_item.h"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Calls use(row, arc) for each body in each span, on a thread of its own.
template <class SpanOf, class Use>
void for_each_body(const DeviceContext& context, const Arm& arm, int64_t count, SpanOf span_of, Use use) {
  const int64_t rows = count * arm.body_count;
  if (rows == 0) return;
  const int64_t threads = static_cast<int64_t>(looping_blocks_for(context, rows)) * kBlockThreads;
  auto* const memory = context.allocate<JointMotion>(threads * arm.joint_count);
  for_each_item(context, smaller(threads, rows), [=] __device__(int64_t thread) {
    for (int64_t row = thread; row < rows; row += threads) {
      const int64_t body = row % arm.body_count;
      const ArmSpan span = span_of(row / arm.body_count);
      const JointChain chain = chain_of(arm, body, 0, memory + thread * arm.joint_count);
      for (int32_t n = 0; n < chain.count; ++n) place_joint(arm, span, chain, n);
      use(row, arc_of_body(arm, chain, span.begin == span.end, arm.body_reach[body]));
    }
  });
}

}  // namespace

void arm_poses(const DeviceContext& context, const Arm& arm, const double* q, int64_t count, const ArmPoses& out) {
  for_each_body(
      context, arm, count, [=] __device__(int64_t k) { return still_span(arm, q + k * arm.coordinate_count); },
      [=] __device__(int64_t row, const ArmArc& arc) { store_pose(out, row, arc.start); });
}

void arm_arcs(const DeviceContext& context, const Arm& arm, const ArmSpans& spans, const ArmArcs& out) {
  for_each_body(
      context, arm, spans.paths.path_count, [=] __device__(int64_t k) { return spans.span(arm, k); },
      [=] __device__(int64_t row, const ArmArc& arc) { store_arc(out, row, arc); });
}

}  // namespace pgccd
