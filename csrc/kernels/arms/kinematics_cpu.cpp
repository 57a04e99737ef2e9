#include <vector>

#include "kernels/arms/kinematics.h"
namespace pgccd {
namespace {

constexpr int64_t kGrain = 16;

// Calls use(row, arc) for each body in each span.
template <class SpanOf, class Use>
void for_each_body(const Executor& executor, const Arm& arm, int64_t count, SpanOf&& span_of, Use&& use) {
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    std::vector<JointMotion> joints(arm.joint_count);
    for (int64_t k = begin; k < end; ++k) {
      const ArmSpan span = span_of(k);
      for (int64_t body = 0; body < arm.body_count; ++body) {
        const JointChain chain = chain_of(arm, body, 0, joints.data());
        for (int32_t n = 0; n < chain.count; ++n) place_joint(arm, span, chain, n);
        use(k * arm.body_count + body, arc_of_body(arm, chain, span.begin == span.end, arm.body_reach[body]));
      }
    }
  });
}

}  // namespace

void arm_poses(const Executor& executor, const Arm& arm, const double* q, int64_t count, const ArmPoses& out) {
  for_each_body(
      executor, arm, count, [&](int64_t k) { return still_span(arm, q + k * arm.coordinate_count); },
      [&](int64_t row, const ArmArc& arc) { store_pose(out, row, arc.start); });
}

void arm_arcs(const Executor& executor, const Arm& arm, const ArmSpans& spans, const ArmArcs& out) {
  for_each_body(
      executor, arm, spans.paths.path_count, [&](int64_t k) { return spans.span(arm, k); },
      [&](int64_t row, const ArmArc& arc) { store_arc(out, row, arc); });
}

}  // namespace pgccd
