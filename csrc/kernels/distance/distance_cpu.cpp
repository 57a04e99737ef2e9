#include "kernels/distance/distance.h"
#include "kernels/distance/distance_item.h"

namespace pgccd {

template <class Bodies>
void distances(const Executor& executor, const Bodies& bodies, const DistanceInput& input, const DistanceColumns& out) {
  require_rows(executor, input.pair_count, "pairs", "name two bodies", [&](int64_t row) {
    return is_sound(bodies, input.pairs[2 * row]) && is_sound(bodies, input.pairs[2 * row + 1]);
  });
  parallel_chunks(executor, input.pair_count, 1, [&](int, int64_t begin, int64_t end) {
    DistanceMemory memory;
    for (int64_t row = begin; row < end; ++row) find_distance(bodies, input, row, memory, out);
  });
}

template void distances(const Executor&, const RigidBodies&, const DistanceInput&, const DistanceColumns&);
template void distances(const Executor&, const DeformingBodies&, const DistanceInput&, const DistanceColumns&);

}  // namespace pgccd
