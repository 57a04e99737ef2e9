#include "kernels/broad/broad_cuda.h"
#include "kernels/broad/pair_list.cuh"

namespace pgccd {

void find_pairs_cuda(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                     const PairSink& out) {
  note_beginning(context, out);
  if (bodies.count < 2) return write_no_pairs(context, out);
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
