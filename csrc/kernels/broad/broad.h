// Broad phases: swept spheres in, potentially colliding set (PCS) out. All of them return the same rows: every pair
// with is_potentially_colliding, sorted.
#pragma once

#include <cstdint>
#include <functional>
#include <variant>

#include "core/scalar.h"
#include "kernels/broad/box_item.h"
#include "kernels/broad/meeting_item.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/padded_pairs.h"

namespace pgccd {

// Names in the same order: pgccd/search/broad.py.
enum class BroadPhase : int64_t {
  kSweep = 0,
  kGrid = 1,
  kLbvh = 2,
};
constexpr int64_t kBroadPhases = 3;

struct BroadPhaseChoice {
  BroadPhase phase;
  int axis = -1;  // of a sweep: 0, 1, 2, or -1 for the axis with the largest variance of centres
};

// Called once with the number of pairs; returns the memory for their rows (i, j): i < j, sorted by i, then j.
using PairOutput = std::function<int64_t*(int64_t count)>;

// An output of exactly the size needed; or one of fixed capacity, for which a device does not synchronise.
using PairSink = std::variant<PairOutput, PaddedPairs>;

// Runs the chosen broad phase. With padded pairs, none are found if the bodies are invalid.
void find_pairs(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                const PairSink& out);
void find_pairs(const DeviceContext& context, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                const PairSink& out);

// The PCS in a buffer of its exact size, with the counts of padded pairs; empty if the bodies are invalid, or if there
// are more than `most` pairs.
void find_pairs_exactly(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                        int64_t most, const PairOutput& make_output, int64_t* counts);

// Selects the pairs that meet at equal times: meeting (pairs.count, 2), in the same order, padded with -1; `found` (1,)
// is their number.
void meeting_pairs(const Executor& executor, const SweptPairs& pairs, int64_t* meeting, int64_t* found);
void meeting_pairs(const DeviceContext& context, const SweptPairs& pairs, int64_t* meeting, int64_t* found);

// Sweep and prune. On a device, here and below: at least two bodies.
void find_pairs_by_sweep(const Executor& executor, const BroadBodies& bodies, int axis, const PairOutput& make_output);
void find_pairs_by_sweep(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairSink& out);

// Hashed grid with a level for each octave of body sizes.
void find_pairs_by_grid(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);
void find_pairs_by_grid(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);

// Linear bounding volume hierarchy.
void find_pairs_by_lbvh(const Executor& executor, const BroadBodies& bodies, const PairOutput& make_output);
void find_pairs_by_lbvh(const DeviceContext& context, const BroadBodies& bodies, const PairSink& out);

// A packed pair: the smaller index in the upper half.
PGCCD_HD uint64_t pack_pair(int32_t a, int32_t b) {
  return (static_cast<uint64_t>(smaller(a, b)) << 32) | static_cast<uint32_t>(larger(a, b));
}
PGCCD_HD int32_t first_of(uint64_t pair) { return static_cast<int32_t>(pair >> 32); }
PGCCD_HD int32_t second_of(uint64_t pair) { return static_cast<int32_t>(pair & 0xffffffffu); }

}  // namespace pgccd
