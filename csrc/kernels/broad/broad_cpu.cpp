#include <algorithm>
#include <vector>

#include "kernels/broad/broad.h"
#include "kernels/find_rows.h"

namespace pgccd {
namespace {

void find_all(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
              const PairOutput& make_output) {
  switch (choice.phase) {
    case BroadPhase::kSweep:
      return find_pairs_by_sweep(executor, bodies, choice.axis, make_output);
    case BroadPhase::kGrid:
      return find_pairs_by_grid(executor, bodies, make_output);
    case BroadPhase::kLbvh:
      return find_pairs_by_lbvh(executor, bodies, make_output);
  }
}

void count_pairs(int64_t began, int64_t found, int64_t written, int64_t* counts) {
  counts[kPairsNeeded] = found;
  counts[kOverlapsNeeded] = counts[kLongRowsNeeded] = 0;
  counts[kPairsWritten] = written;
  counts[kPairsOverflow] = found > written;
  counts[kBroadBegan] = began;
  counts[kBroadEnded] = host_nanoseconds();
}

void find_padded(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                 const PaddedPairs& out) {
  const int64_t began = host_nanoseconds(), capacity = out.capacity.pairs;
  std::vector<int64_t> too_many;
  int64_t count = 0;
  const auto make_output = [&](int64_t found) {
    count = found;
    if (found <= capacity) return out.rows;
    too_many.resize(2 * found);
    return too_many.data();
  };
  if (!bodies.invalid()) find_all(executor, bodies, choice, make_output);
  const int64_t written = std::min(count, capacity);
  if (!too_many.empty()) std::copy_n(too_many.data(), 2 * written, out.rows);
  std::fill(out.rows + 2 * written, out.rows + 2 * capacity, int64_t{-1});
  count_pairs(began, count, written, out.counts);
}

}  // namespace

void find_pairs(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                const PairSink& out) {
  if (const auto* padded = std::get_if<PaddedPairs>(&out)) {
    find_padded(executor, bodies, choice, *padded);
  } else {
    find_all(executor, bodies, choice, std::get<PairOutput>(out));
  }
}

void find_pairs_exactly(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                        int64_t most, const PairOutput& make_output, int64_t* counts) {
  const int64_t began = host_nanoseconds();
  std::vector<int64_t> too_many;
  int64_t count = 0;
  const auto rows = [&](int64_t found) {
    count = found;
    if (found <= most) return make_output(found);
    make_output(0);
    too_many.resize(2 * found);
    return too_many.data();
  };
  if (bodies.invalid()) {
    make_output(0);
  } else {
    find_all(executor, bodies, choice, rows);
  }
  count_pairs(began, count, count <= most ? count : 0, counts);
}

void meeting_pairs(const Executor& executor, const SweptPairs& pairs, int64_t* meeting, int64_t* found) {
  require_rows(executor, pairs.count, "pairs", "are padding, or name bodies",
               [&](int64_t k) { return is_sound(pairs, k); });
  std::vector<int64_t> kept(static_cast<size_t>(pairs.count));
  find_rows(executor, pairs.count, kept.data(), found, [&](int64_t k) { return meets(pairs, k); });
  for (int64_t k = 0; k < pairs.count; ++k) store_meeting_pair(pairs, kept.data(), *found, k, meeting);
}

}  // namespace pgccd
