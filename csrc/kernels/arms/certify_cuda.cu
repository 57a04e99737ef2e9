#include "kernels/arms/warp_team.cuh"

namespace pgccd {
namespace {

constexpr int kPathThreads = 64;
constexpr int kPathWarps = kPathThreads / kWarp;
// Resident blocks per multiprocessor: searches wait for memory and for one another's lanes more than for registers.
constexpr int kPathBlocks = 8;
// Memory of all searches.
constexpr int64_t kMostBytes = int64_t{1} << 30;

}  // namespace

// Each warp takes the next path when it is done with one: paths differ in cost by a factor of a hundred.
__global__ void __launch_bounds__(kPathThreads, kPathBlocks)
    certify_kernel(ArmScene scene, ArmPaths paths, double resolution, PathVerdicts out, char* memory, int64_t bytes,
                   NodePair* stacks, uint32_t* next) {
  wait_for_previous_kernels();
  __shared__ WarpShared shared[kPathWarps];
  const int warp_of_block = static_cast<int>(threadIdx.x) / kWarp;
  const int64_t warp = static_cast<int64_t>(blockIdx.x) * kPathWarps + warp_of_block;
  WarpTeam team(shared[warp_of_block], stacks + warp * kWarpStack);
  PathSearch<WarpTeam> search(scene, paths, resolution, {scene, memory + warp * bytes}, team);
  for (;;) {
    uint32_t path = 0;
    if (team.index() == 0) path = atomicAdd(next, 1u);
    path = __shfl_sync(kAllLanes, path, 0);
    if (path >= paths.path_count) return;
    const PathVerdict found = search.certify(path, {});
    if (team.index() == 0) store_verdict(out, path, found, scene);
  }
}

void certify(const DeviceContext& context, const ArmScene& scene, const ArmPaths& paths, double resolution,
             const PathVerdicts& out) {
  if (paths.path_count == 0) return;
  const int64_t needed = (paths.path_count + kPathWarps - 1) / kPathWarps;
  const int64_t bytes = SearchMemory::bytes(scene);
  // Scenes of very many pairs are searched by fewer warps.
  const int64_t affordable = larger<int64_t>(kMostBytes / (kPathWarps * bytes), 1);
  const int64_t resident = resident_blocks_of(context, certify_kernel, kPathThreads);
  const int64_t blocks = smaller(smaller(needed, resident), affordable);
  auto* const memory = context.allocate<char>(blocks * kPathWarps * bytes);
  auto* const stacks = context.allocate<NodePair>(blocks * kPathWarps * kWarpStack);
  auto* const next = context.allocate<uint32_t>(1);
  fill_bytes(context, next, 0, 1);
  launch_kernel(context, certify_kernel, static_cast<unsigned>(blocks), kPathThreads, scene, paths, resolution, out,
                memory, bytes, stacks, next);
}

}  // namespace pgccd
