#include "kernels/broad/pair_list.cuh"

namespace pgccd {

void find_pairs(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                const PairSink& out) {
  note_beginning(context, out);
  if (bodies.count < 2) return write_no_pairs(context, out);
  switch (choice.phase) {
    case BroadPhase::kSweep:
      return find_pairs_by_sweep(context, bodies, choice.axis, out);
    case BroadPhase::kGrid:
      return find_pairs_by_grid(context, bodies, out);
    case BroadPhase::kLbvh:
      return find_pairs_by_lbvh(context, bodies, out);
  }
}

}  // namespace pgccd
