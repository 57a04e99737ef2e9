// From candidates to contacts. A first kernel decides the candidates of t = 0. One kernel for each phase of
// advancement.h follows: the quick phase for every other candidate, the plain one for those it leaves open, the patient
// one for the few still open. The candidate of a pair with the smallest certified lower bound of toi is likely the
// first contact: the plain phase solves these first, so that most others can be skipped.
#pragma once

#include <type_traits>

#include "kernels/launch.cuh"
#include "kernels/narrow/search.cuh"
#include "kernels/warp_share.cuh"

namespace pgccd {

// Small blocks spread long searches over many multiprocessors.
constexpr int kSolveThreads = 64;
// Resident blocks of the plain phase on a multiprocessor: more would have too few registers.
template <class Bodies>
constexpr int kPlainBlocks = std::is_same_v<Bodies, RigidBodies> ? 4 : 6;
// Up to this many candidates, the quick phase takes longer than what it saves the plain one.
constexpr int64_t kFewCandidates = 1 << 15;

template <class Bodies>
__device__ PairOf<Bodies> pair_of(const Bodies& bodies, const NarrowInput& input, const Candidate& c) {
  return {bodies, input.pairs[2 * int64_t(c.pair)], input.pairs[2 * int64_t(c.pair) + 1]};
}

__device__ inline void leave_open(const Search& search, int64_t at, const Progress<double>& progress, int64_t row,
                                  int32_t pair) {
  if (at < search.capacity) {
    search.open[at] = {progress.t, progress.goal, progress.advances, static_cast<int32_t>(row), pair, 0};
  }
  if (search.least != nullptr) atomicMin(search.least + pair, toi_bits(progress.t));
}

// The few candidates that the bodies at t = 0 decide. A kernel of their own: the registers of their tests, in any
// branch of the phases, would make the phases a sixth slower.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads) search_starts(Bodies bodies, Search search) {
  wait_for_previous_kernels();
  __shared__ WaitingItems waiting[kSolveThreads / kWarp];
  const CandidateSpan candidates = search.input.candidates;
  const auto is_wanted = [&](uint32_t k) { return is_of_start(candidates.items[candidates.place(k)]); };
  const auto search_start = [&](uint32_t k) {
    const int64_t row = candidates.place(k);
    const Candidate candidate = candidates.items[row];
    if (!prospect_of(search, candidate.pair).is_needed) return;
    const auto pair = pair_of(bodies, search.input, candidate);
    const auto fine = [&] { return pair.fine(bodies); };
    report(search, static_cast<int32_t>(row), candidate.pair, solve_start(bodies, pair, fine, candidate));
  };
  for_each_selected(0, static_cast<uint32_t>(candidates.count()), waiting[threadIdx.x / kWarp], is_wanted,
                    search_start);
}

// One thread per candidate. The few candidates of a small search are all left to the plain phase.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads, 3) search_quickly(Bodies bodies, Search search) {
  wait_for_previous_kernels();
  const CandidateSpan candidates = search.input.candidates;
  const int64_t count = candidates.count(), before = search.counters->open_before;
  const int64_t thread = int64_t{blockIdx.x} * blockDim.x + threadIdx.x, stride = int64_t{gridDim.x} * blockDim.x;
  if (count <= kFewCandidates && before + count <= search.capacity) {
    for (int64_t k = thread; k < count; k += stride) {
      if (k == 0) atomicAdd(&search.counters->open, static_cast<uint32_t>(count));
      const int64_t c = candidates.place(k);
      leave_open(search, before + k, {}, c, candidates.items[c].pair);
    }
    return;
  }
  for (int64_t k = thread; k < count; k += stride) {
    const int64_t c = candidates.place(k);
    const Candidate candidate = candidates.items[c];
    if (is_of_start(candidate)) continue;
    const auto pair = pair_of(bodies, search.input, candidate);
    const Prospect prospect = prospect_of(search, candidate.pair);
    Progress<double> progress;
    if (!prospect.is_needed ||
        is_quickly_free(bodies, pair, candidate, search.input.settings, prospect.latest, progress)) {
      continue;
    }
    leave_open(search, warp_append(&search.counters->open), progress, c, candidate.pair);
  }
}

template <class Bodies>
__device__ void solve_open(const Bodies& bodies, const Search& search, uint32_t item) {
  const OpenCandidate open = search.open[item];
  const Prospect prospect = prospect_of(search, open.pair);
  if (!prospect.is_needed || open.t > prospect.latest) return;
  const Candidate candidate = search.input.candidates.items[open.row];
  if (is_of_start(candidate)) return;
  const auto pair = pair_of(bodies, search.input, candidate);
  const Outcome<double> outcome =
      solve_plainly(bodies, pair, candidate, search.input.settings, prospect.latest, open.progress());
  if (outcome.status == Status::kOpen) {
    search.patient[warp_append(&search.counters->patient)] = item;
  } else {
    report(search, open.row, open.pair, outcome);
  }
}

// Of one part, the first launch solves the candidates that are likely first contacts, or all if there is a thread for
// each or none is likely (`least` is null); the second those that may be earlier than the contacts found.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads, kPlainBlocks<Bodies>)
    search_plainly(Bodies bodies, Search search, bool is_first) {
  wait_for_previous_kernels();
  __shared__ WaitingItems waiting[kSolveThreads / kWarp];
  const uint32_t begin = search.counters->open_before, end = smaller(search.counters->open, search.capacity);
  const bool all_at_once = search.least == nullptr || end - begin <= gridDim.x * blockDim.x;
  if (all_at_once && !is_first) return;
  const auto is_wanted = [&](uint32_t item) {
    if (all_at_once) return true;
    const OpenCandidate& candidate = search.open[item];
    const unsigned long long time = toi_bits(candidate.t);
    if (time == search.least[candidate.pair]) return is_first;
    return !is_first && time <= search.best_of(candidate.pair);
  };
  for_each_selected(begin, end, waiting[threadIdx.x / kWarp], is_wanted,
                    [&](uint32_t item) { solve_open(bodies, search, item); });
}

// The patient phase, of all parts, after repeating the plain one, whose progress is not stored.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads) search_patiently(Bodies bodies, Search search) {
  wait_for_previous_kernels();
  // Rows of the first part may be overwritten if not all candidates fit.
  const uint32_t count = search.input.candidates.fits_all() ? search.counters->patient : 0;
  const WarpShare share = share_of_warp(count);
  const uint32_t lane = threadIdx.x % kWarp;
  for (uint32_t k = share.begin + lane; lane < share.lanes && k < count; k += share.stride) {
    const OpenCandidate open = search.open[search.patient[k]];
    const Prospect prospect = prospect_of(search, open.pair);
    if (!prospect.is_needed) continue;
    const Candidate candidate = search.input.candidates.items[open.row];
    const auto pair = pair_of(bodies, search.input, candidate);
    report(search, open.row, open.pair,
           solve_candidate(bodies, pair, candidate, search.input.settings, prospect.latest, open.progress()));
  }
}

template <class Bodies>
void launch_starts(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  launch_kernel(context, search_starts<Bodies>, resident_blocks_of(context, search_starts<Bodies>, kSolveThreads),
                kSolveThreads, bodies, search);
}

template <class Bodies>
void launch_quickly(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  launch_kernel(context, search_quickly<Bodies>, resident_blocks_of(context, search_quickly<Bodies>), kBlockThreads,
                bodies, search);
}

template <class Bodies>
void launch_plainly(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  const int blocks = resident_blocks_of(context, search_plainly<Bodies>, kSolveThreads);
  const bool all_at_once =
      search.least == nullptr || search.capacity <= static_cast<uint32_t>(blocks) * uint32_t{kSolveThreads};
  for (const bool is_first : {true, false}) {
    if (!is_first && all_at_once) break;
    launch_kernel(context, search_plainly<Bodies>, blocks, kSolveThreads, bodies, search, is_first);
  }
}

// Before the second part. Of this one most first contacts are known, so its likely ones need not be solved first.
inline void end_first_part(const DeviceContext& context, Search& search) {
  SearchCounters* counters = search.counters;
  const uint32_t capacity = search.capacity;
  for_each_item(context, 1, [=] __device__(int64_t) { counters->open_before = smaller(counters->open, capacity); });
  search.least = nullptr;
}

template <class Bodies>
void launch_patiently(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  launch_kernel(context, search_patiently<Bodies>, resident_blocks_of(context, search_patiently<Bodies>, kSolveThreads),
                kSolveThreads, bodies, search);
}

}  // namespace pgccd
