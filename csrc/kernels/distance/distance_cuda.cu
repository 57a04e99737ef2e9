#include "kernels/distance/distance.h"
#include "kernels/distance/distance_item.h"
#include "kernels/launch.cuh"

namespace pgccd {

// One thread a pair, in blocks of a warp: pairs differ in cost, and few of them shall use many multiprocessors.
template <class Bodies>
__global__ void __launch_bounds__(kWarp)
    distance_kernel(Bodies bodies, DistanceInput input, DistanceMemory* memory, DistanceColumns out) {
  wait_for_previous_kernels();
  const int64_t thread = static_cast<int64_t>(blockIdx.x) * kWarp + threadIdx.x;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * kWarp;
  for (int64_t row = thread; row < input.pair_count; row += stride) {
    const bool is_named = is_sound(bodies, input.pairs[2 * row]) && is_sound(bodies, input.pairs[2 * row + 1]);
    require_on_device(is_named, "pairs: expected rows that name two bodies");
    find_distance(bodies, input, row, memory[thread], out);
  }
}

template <class Bodies>
void distances(const DeviceContext& context, const Bodies& bodies, const DistanceInput& input,
               const DistanceColumns& out) {
  if (input.pair_count == 0) return;
  const int64_t needed = (input.pair_count + kWarp - 1) / kWarp;
  const int64_t blocks = smaller<int64_t>(needed, resident_blocks_of(context, distance_kernel<Bodies>, kWarp));
  auto* const memory = context.allocate<DistanceMemory>(blocks * kWarp);
  launch_kernel(context, distance_kernel<Bodies>, static_cast<unsigned>(blocks), kWarp, bodies, input, memory, out);
}

template void distances(const DeviceContext&, const RigidBodies&, const DistanceInput&, const DistanceColumns&);
template void distances(const DeviceContext&, const DeformingBodies&, const DistanceInput&, const DistanceColumns&);

}  // namespace pgccd
