#include <algorithm>
#include <vector>

#include "kernels/arms/host_team.h"

namespace pgccd {

void certify(const Executor& executor, const ArmScene& scene, const ArmPaths& paths, double resolution,
             const PathVerdicts& out) {
  const int64_t grain = std::max<int64_t>(1, paths.path_count / (16 * executor.worker_count()));
  parallel_chunks(executor, paths.path_count, grain, [&](int, int64_t begin, int64_t end) {
    std::vector<double> memory(SearchMemory::bytes(scene) / sizeof(double));
    HostTeam team;
    PathSearch<HostTeam> search(scene, paths, resolution, {scene, reinterpret_cast<char*>(memory.data())}, team);
    for (int64_t path = begin; path < end; ++path) store_verdict(out, path, search.certify(path, {}), scene);
  });
}

}  // namespace pgccd
