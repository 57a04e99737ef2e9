// From candidates to contacts, in the phases of advancement.h, one kernel each: the quick phase for every candidate,
// the plain one for those it leaves open, the patient one for the few still open. The candidate of a pair with the
// smallest certified lower bound of toi is likely the first contact: the plain phase solves these first, so that most
// others can be skipped.
#pragma once

#include "kernels/narrow/search.cuh"

namespace pgccd {

// Small blocks spread long searches over many multiprocessors.
constexpr int kSolveThreads = 64;

template <class Bodies>
__device__ typename PairOf<Bodies>::type pair_of(const Bodies& bodies, const NarrowInput& input, const Candidate& c) {
  return {bodies, input.pairs[2 * int64_t(c.pair)], input.pairs[2 * int64_t(c.pair) + 1]};
}

// One thread per candidate.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads, 3) search_quickly(Bodies bodies, Search search) {
  const CandidateSpan candidates = search.input.candidates;
  const int64_t count = candidates.count(), stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t k = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; k < count; k += stride) {
    const int64_t c = candidates.place(k);
    const Candidate candidate = candidates.items[c];
    const auto pair = pair_of(bodies, search.input, candidate);
    const Prospect prospect = prospect_of(search, candidate.pair);
    Progress<double> progress;
    if (!prospect.is_needed ||
        is_quickly_free(bodies, pair, candidate, search.input.settings, prospect.latest, progress)) {
      continue;
    }
    const uint32_t at = warp_append(&search.counters->open, 1);
    if (at < search.capacity) {
      search.open[at] = {progress.t, progress.goal, progress.advances, static_cast<int32_t>(c), candidate.pair, 0};
    }
    if (search.least != nullptr) atomicMin(search.least + candidate.pair, toi_bits(progress.t));
  }
}

template <class Bodies>
__device__ void solve_open(const Bodies& bodies, const Search& search, uint32_t item) {
  const OpenCandidate open = search.open[item];
  const Prospect prospect = prospect_of(search, open.pair);
  if (!prospect.is_needed || open.t > prospect.latest) return;
  const Candidate candidate = search.input.candidates.items[open.row];
  const auto pair = pair_of(bodies, search.input, candidate);
  const Outcome<double> outcome =
      solve_plainly(bodies, pair, candidate, search.input.settings, prospect.latest, open.progress());
  if (outcome.status == Status::kOpen) {
    search.patient[warp_append(&search.counters->patient, 1)] = item;
  } else {
    report(search, open, outcome);
  }
}

// The first of two launches solves the candidates that are likely first contacts, or all if there is a thread for each;
// the second those that may be earlier than the contacts found. A warp collects them, so that its lanes are full.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads, 6) search_plainly(Bodies bodies, Search search, bool is_first) {
  __shared__ uint32_t all_waiting[kSolveThreads / kWarp][2 * kWarp];
  const int lane = threadIdx.x % kWarp;
  uint32_t* const waiting = all_waiting[threadIdx.x / kWarp];
  const uint2 range = search.open_range();
  const uint32_t threads = gridDim.x * blockDim.x;
  const bool all_at_once = search.least == nullptr || range.y - range.x <= threads;
  if (all_at_once && !is_first) return;
  const auto is_wanted = [&](uint32_t item) {
    if (all_at_once) return true;
    const OpenCandidate& open = search.open[item];
    const unsigned long long begin = toi_bits(open.t);
    if (begin == search.least[open.pair]) return is_first;
    return !is_first && begin <= search.best_of(open.pair);
  };
  uint32_t collected = 0;
  for (uint32_t base = range.x + blockIdx.x * blockDim.x + threadIdx.x - lane;; base += threads) {
    const bool is_last = base >= range.y;  // solve the remaining ones
    if (!is_last) {
      const uint32_t item = base + lane;
      const bool wanted = item < range.y && is_wanted(item);
      const uint32_t lanes = __ballot_sync(kAllLanes, wanted);
      if (wanted) waiting[collected + __popc(lanes & lanes_below(lane))] = item;
      collected += __popc(lanes);
      if (collected < kWarp) continue;
    }
    __syncwarp();
    const uint32_t some = smaller<uint32_t>(collected, kWarp);
    collected -= some;
    const uint32_t mine = lane < some ? waiting[collected + lane] : 0u;
    __syncwarp();  // before other lanes overwrite them
    if (lane < some) solve_open(bodies, search, mine);
    if (is_last) return;
  }
}

// The patient phase, of all parts, after repeating the plain one, whose progress is not stored.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads) search_patiently(Bodies bodies, Search search) {
  const uint32_t count = search.counters->patient, threads = gridDim.x * blockDim.x;
  for (uint32_t k = blockIdx.x * blockDim.x + threadIdx.x; k < count; k += threads) {
    const OpenCandidate open = search.open[search.patient[k]];
    const Prospect prospect = prospect_of(search, open.pair);
    if (!prospect.is_needed) continue;
    const Candidate candidate = search.input.candidates.items[open.row];
    const auto pair = pair_of(bodies, search.input, candidate);
    report(search, open,
           solve_candidate(bodies, pair, candidate, search.input.settings, prospect.latest, open.progress()));
  }
}

// The quick and the plain phase of one part of the candidates.
template <class Bodies>
void search_part(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  search_quickly<Bodies>
      <<<resident_blocks_of(search_quickly<Bodies>), kBlockThreads, 0, context.stream>>>(bodies, search);
  check_cuda(cudaGetLastError(), "search_quickly");
  const int blocks = resident_blocks_of(search_plainly<Bodies>, kSolveThreads);
  for (const bool is_first : {true, false}) {
    if (!is_first && search.least == nullptr) break;
    search_plainly<Bodies><<<blocks, kSolveThreads, 0, context.stream>>>(bodies, search, is_first);
    check_cuda(cudaGetLastError(), "search_plainly");
  }
}

// Before the next part. Of this one most contacts are known, so its likely ones need not be solved first.
inline void end_part(const DeviceContext& context, Search& search) {
  SearchCounters* counters = search.counters;
  const uint32_t capacity = search.capacity;
  for_each_item(context, 1, [=] __device__(int64_t) { counters->open_before = smaller(counters->open, capacity); });
  search.least = nullptr;
}

template <class Bodies>
void search_patiently_all(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  const int patient_blocks = resident_blocks_of(search_patiently<Bodies>, kSolveThreads);
  search_patiently<Bodies><<<patient_blocks, kSolveThreads, 0, context.stream>>>(bodies, search);
  check_cuda(cudaGetLastError(), "search_patiently");
}

}  // namespace pgccd
