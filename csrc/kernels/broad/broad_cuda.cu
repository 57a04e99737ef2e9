#include "kernels/broad/pair_list.cuh"
#include "kernels/find_rows.cuh"
#include "kernels/launch.cuh"

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

void meeting_pairs(const DeviceContext& context, const SweptPairs& pairs, int64_t* meeting, int64_t* found) {
  int64_t* kept = context.allocate<int64_t>(pairs.count);
  find_rows(context, pairs.count, kept, found, [=] __device__(int64_t k) {
    require_on_device(is_sound(pairs, k), "pairs: expected padding, or bodies");
    return meets(pairs, k);
  });
  for_each_item(context, pairs.count,
                [=] __device__(int64_t k) { store_meeting_pair(pairs, kept, *found, k, meeting); });
}

}  // namespace pgccd
