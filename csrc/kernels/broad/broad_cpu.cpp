#include "kernels/broad/broad.h"

namespace pgccd {

void find_pairs_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                    const PairOutput& make_output) {
  switch (choice.phase) {
    case BroadPhase::kSweep:
      return sweep_cpu(executor, bodies, choice.axis, make_output);
    case BroadPhase::kGrid:
      return grid_cpu(executor, bodies, make_output);
    case BroadPhase::kLbvh:
      return lbvh_cpu(executor, bodies, make_output);
  }
}

}  // namespace pgccd
