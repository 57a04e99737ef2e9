#include "core/feature_lanes.h"
#include "kernels/narrow/elementary_item.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {
namespace {

constexpr int64_t kQueryGrain = 256;

// Culled queries, of up to kLanes, one bit each.
template <FeatureKind kKind, class T>
uint32_t culled_lanes(const T* points_t0, const T* points_t1, int64_t count, float distance) {
  FeatureLanes start, end;
  for (int lane = 0; lane < count; ++lane) {
    start.set(lane, rounded_differences<kKind>(points_t0 + 12 * lane));
    end.set(lane, rounded_differences<kKind>(points_t1 + 12 * lane));
  }
  const uint32_t used = (1u << count) - 1u;
  return used & lane_bits(stays_apart(start.pairs(), end.pairs(), distance, kIsEdgeEdge<kKind>, lanes_without(used)));
}

}  // namespace

template <FeatureKind kKind, class T>
void elementary(const Executor& executor, const T* points_t0, const T* points_t1, int64_t count,
                const NarrowSettings& settings, const ElementaryColumns<T>& out) {
  const float distance = cull_distance(settings);
  parallel_chunks(executor, count, kQueryGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t block = begin; block < end; block += kLanes) {
      const int64_t block_end = smaller(block + kLanes, end);
      const uint32_t culled =
          culled_lanes<kKind>(points_t0 + 12 * block, points_t1 + 12 * block, block_end - block, distance);
      for (int64_t q = block; q < block_end; ++q) {
        const bool free = (culled >> (q - block)) & 1;
        store(out, q,
              free ? culled_answer<T>() : solve_elementary<kKind>(points_t0 + 12 * q, points_t1 + 12 * q, settings));
      }
    }
  });
}

template void elementary<FeatureKind::kVertexFace>(const Executor&, const float*, const float*, int64_t,
                                                   const NarrowSettings&, const ElementaryColumns<float>&);
template void elementary<FeatureKind::kEdgeEdge>(const Executor&, const float*, const float*, int64_t,
                                                 const NarrowSettings&, const ElementaryColumns<float>&);
template void elementary<FeatureKind::kVertexFace>(const Executor&, const double*, const double*, int64_t,
                                                   const NarrowSettings&, const ElementaryColumns<double>&);
template void elementary<FeatureKind::kEdgeEdge>(const Executor&, const double*, const double*, int64_t,
                                                 const NarrowSettings&, const ElementaryColumns<double>&);

}  // namespace pgccd
