#include "kernels/narrow/elementary_item.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {
namespace {

constexpr int64_t kQueryGrain = 256;

// Nine columns of a feature pair's coordinates, one lane per query.
struct LaneColumns {
  alignas(32) float column[9][kLanes];

  void set(int lane, const FeaturePair<float>& p) {
    const Vec3<float> vectors[3] = {p.r, p.a, p.b};
    for (int k = 0; k < 3; ++k) {
      column[3 * k][lane] = vectors[k].x;
      column[3 * k + 1][lane] = vectors[k].y;
      column[3 * k + 2][lane] = vectors[k].z;
    }
  }
  Vec3<Float8> vector(int k) const {
    return {load<Float8>(column[3 * k]), load<Float8>(column[3 * k + 1]), load<Float8>(column[3 * k + 2])};
  }
  FeaturePair<Float8> pairs() const { return {vector(0), vector(1), vector(2)}; }
};

// Culled queries, of up to kLanes, one bit each.
template <FeatureKind kKind, class T>
uint32_t culled_lanes(const T* points_t0, const T* points_t1, int64_t count, float distance) {
  if (count < kLanes) {
    uint32_t culled = 0;
    for (int64_t q = 0; q < count; ++q) {
      const bool free = stays_apart(rounded_differences<kKind>(points_t0 + 12 * q),
                                    rounded_differences<kKind>(points_t1 + 12 * q), distance, kIsEdgeEdge<kKind>);
      culled |= static_cast<uint32_t>(free) << q;
    }
    return culled;
  }
  LaneColumns start, end;
  for (int lane = 0; lane < kLanes; ++lane) {
    start.set(lane, rounded_differences<kKind>(points_t0 + 12 * lane));
    end.set(lane, rounded_differences<kKind>(points_t1 + 12 * lane));
  }
  return lane_bits(stays_apart(start.pairs(), end.pairs(), distance, kIsEdgeEdge<kKind>));
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
