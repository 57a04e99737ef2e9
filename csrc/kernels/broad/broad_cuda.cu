#include "kernels/broad/broad_cuda.h"

namespace pgccd {

void find_pairs_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                     const PairSink& out) {
  switch (choice.phase) {
    case BroadPhase::kSweep:
      return sweep_cuda(context, bodies, choice.axis, out);
    case BroadPhase::kGrid:
      return grid_cuda(context, bodies, out);
    case BroadPhase::kLbvh:
      return lbvh_cuda(context, bodies, out);
  }
}

}  // namespace pgccd
