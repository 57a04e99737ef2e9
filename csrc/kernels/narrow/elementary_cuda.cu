#include "kernels/launch.cuh"
#include "kernels/narrow/elementary_item.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {

template <FeatureKind kKind, class T>
void elementary(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                const NarrowSettings& settings, const ElementaryColumns<T>& out) {
  for_each_item(context, count, [=] __device__(int64_t q) {
    const T *start = points_t0 + 12 * q, *end = points_t1 + 12 * q;
    const bool free = stays_apart(rounded_differences<kKind>(start), rounded_differences<kKind>(end),
                                  cull_distance(settings), kIsEdgeEdge<kKind>, false);
    store(out, q, free ? culled_answer<T>() : solve_elementary<kKind>(start, end, settings));
  });
}

template void elementary<FeatureKind::kVertexFace>(const DeviceContext&, const float*, const float*, int64_t,
                                                   const NarrowSettings&, const ElementaryColumns<float>&);
template void elementary<FeatureKind::kEdgeEdge>(const DeviceContext&, const float*, const float*, int64_t,
                                                 const NarrowSettings&, const ElementaryColumns<float>&);
template void elementary<FeatureKind::kVertexFace>(const DeviceContext&, const double*, const double*, int64_t,
                                                   const NarrowSettings&, const ElementaryColumns<double>&);
template void elementary<FeatureKind::kEdgeEdge>(const DeviceContext&, const double*, const double*, int64_t,
                                                 const NarrowSettings&, const ElementaryColumns<double>&);

}  // namespace pgccd
