// From candidates to contacts: a glance at each, then the rest to their end. Of each pair the candidate that has come
// least far by then is likely to be the first contact: those are solved before the others, most of which need not be.
#pragma once

#include "kernels/device.cuh"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/narrow_cuda.h"

namespace pgccd {

// Long searches, spread over many multiprocessors.
constexpr int kSolveThreads = 64;

// toi >= 0, so its bits are in order; all ones is later than any.
__device__ inline unsigned long long toi_bits(double toi) {
  return static_cast<unsigned long long>(__double_as_longlong(toi));
}

struct FoundContact {
  int32_t candidate;
  int32_t status;
  double toi, u, v;
};

struct SearchCounters {
  uint32_t open;        // candidates that are not free at a glance, those that did not fit included
  uint32_t contacts;    // among them; of first toi: pairs that have one
  uint32_t unresolved;  // of the rows written
  uint32_t blocks_done;
  int64_t rows;  // to report
};

struct OpenCandidate {
  double t, goal;  // of the progress
  int32_t row;     // of the candidates
  int32_t pair;

  PGCCD_HD Progress<double> progress() const { return {t, goal, goal < 0.0 ? 0 : kQuickAdvances}; }
};

// Contacts, in any order; and per pair the earliest toi so far, unless all are to be reported.
struct Search {
  NarrowInput input;
  OpenCandidate* open;
  uint32_t capacity;
  FoundContact* contacts;        // or null, as the next four
  unsigned long long* best;      // bits of the toi
  unsigned long long* least;     // bits of the time before which no open candidate of the pair can touch
  unsigned long long* best_key;  // as the next, to choose among equal ones
  int32_t* winner;               // the contact
  int64_t words;                 // of eight bytes, that these four take
  SearchCounters* counters;

  __device__ bool has_contact(int64_t contact) const { return contact < static_cast<int64_t>(counters->contacts); }
  __device__ const Candidate& candidate(uint32_t contact) const {
    return input.candidates.items[contacts[contact].candidate];
  }
  __device__ unsigned long long best_of(int32_t pair) const {
    return *static_cast<const volatile unsigned long long*>(best + pair);
  }
};

template <class Bodies>
__device__ typename PairOf<Bodies>::type pair_of(const Bodies& bodies, const NarrowInput& input, const Candidate& c) {
  return {bodies, input.pairs[2 * int64_t(c.pair)], input.pairs[2 * int64_t(c.pair) + 1]};
}

// One thread a candidate.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads, 3) glance_at_candidates(Bodies bodies, Search search) {
  const CandidateSpan candidates = search.input.candidates;
  const int64_t count = candidates.count(), stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t k = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; k < count; k += stride) {
    const int64_t c = candidates.place(k);
    const Candidate candidate = candidates.items[c];
    const auto pair = pair_of(bodies, search.input, candidate);
    Progress<double> progress;
    if (free_at_a_glance(bodies, pair, candidate, search.input.settings, progress)) continue;
    const uint32_t at = warp_append(&search.counters->open, 1);
    if (at < search.capacity) search.open[at] = {progress.t, progress.goal, static_cast<int32_t>(c), candidate.pair};
    if (search.least != nullptr) atomicMin(search.least + candidate.pair, toi_bits(progress.t));
  }
}

// Those certainly later than the pair's best so far are cut short, which cannot change the winner.
template <class Bodies>
__device__ void solve_open(const Bodies& bodies, const Search& search, const OpenCandidate& open) {
  const Candidate candidate = search.input.candidates.items[open.row];
  double latest = INFINITY;
  if (search.best != nullptr) {
    const unsigned long long seen = search.best_of(open.pair);
    if (seen != ~0ull) {
      if (search.input.report == Report::kAny) return;
      latest = __longlong_as_double(static_cast<long long>(seen));
    }
  }
  const auto pair = pair_of(bodies, search.input, candidate);
  const Outcome<double> outcome =
      solve_candidate(bodies, pair, candidate, search.input.settings, latest, open.progress());
  if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) return;
  if (search.best != nullptr) atomicMin(search.best + open.pair, toi_bits(outcome.toi));
  if (search.contacts == nullptr) return;
  // No more contacts than open candidates: there is room.
  search.contacts[warp_append(&search.counters->contacts, 1)] = {open.row, static_cast<int32_t>(outcome.status),
                                                                 outcome.toi, outcome.u, outcome.v};
}

// The first of two launches solves those that may well come first, or all, where all have a thread of their own; the
// second what may still come before. A warp collects what it is to solve, so that its lanes are full.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads, 6) solve_candidates(Bodies bodies, Search search, bool is_first) {
  __shared__ uint32_t all_waiting[kSolveThreads / kWarp][2 * kWarp];
  const int lane = threadIdx.x % kWarp;
  uint32_t* const waiting = all_waiting[threadIdx.x / kWarp];
  const uint32_t count = smaller(search.counters->open, search.capacity), threads = gridDim.x * blockDim.x;
  const bool all_at_once = search.least == nullptr || count <= threads;
  if (all_at_once && !is_first) return;
  const auto is_wanted = [&](uint32_t item) {
    if (all_at_once) return true;
    const OpenCandidate& open = search.open[item];
    const unsigned long long begin = toi_bits(open.t);
    if (begin == search.least[open.pair]) return is_first;
    return !is_first && begin <= search.best_of(open.pair);
  };
  uint32_t collected = 0;
  for (uint32_t base = blockIdx.x * blockDim.x + threadIdx.x - lane;; base += threads) {
    const bool is_last = base >= count;  // solve what is left
    if (!is_last) {
      const uint32_t item = base + lane;
      const bool wanted = item < count && is_wanted(item);
      const uint32_t lanes = __ballot_sync(kAllLanes, wanted);
      if (wanted) waiting[collected + __popc(lanes & lanes_below(lane))] = item;
      collected += __popc(lanes);
      if (collected < kWarp) continue;
    }
    __syncwarp();
    const uint32_t some = smaller<uint32_t>(collected, kWarp);
    collected -= some;
    const uint32_t mine = lane < some ? waiting[collected + lane] : 0u;
    __syncwarp();  // others may be written over them
    if (lane < some) solve_open(bodies, search, search.open[mine]);
    if (is_last) return;
  }
}

// `most_open`: candidates that need more than a glance.
inline Search make_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open) {
  Search search{};
  search.input = input;
  search.counters = context.allocate<SearchCounters>(1);
  search.capacity = static_cast<uint32_t>(smaller<int64_t>(most_open, 0x7ffffff0));
  search.open = context.allocate<OpenCandidate>(search.capacity);
  return search;
}

// Room for what is known of each pair's first contact, and which one it is where that is asked for. In one piece, so
// that one launch fills all.
inline void allocate_first(const DeviceContext& context, Search& search, bool with_winner) {
  const int64_t pairs = search.input.pair_count;
  search.words = with_winner ? 3 * pairs + (pairs + 1) / 2 : 2 * pairs;
  search.best = context.allocate<unsigned long long>(search.words);
  search.least = search.best + pairs;
  if (!with_winner) return;
  search.best_key = search.least + pairs;
  search.winner = reinterpret_cast<int32_t*>(search.best_key + pairs);
}

template <class Bodies>
void run_search(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  const int64_t pairs = search.input.pair_count;
  // No toi, no key and no winner yet.
  for_each_item(context, larger<int64_t>(1, search.words), [=] __device__(int64_t k) {
    if (k == 0) *search.counters = {};
    if (k < search.words) search.best[k] = ~0ull;
  });
  if (pairs == 0) return;
  glance_at_candidates<Bodies>
      <<<resident_blocks_of(glance_at_candidates<Bodies>), kBlockThreads, 0, context.stream>>>(bodies, search);
  check_cuda(cudaGetLastError(), "glance_at_candidates");
  const int blocks = resident_blocks_of(solve_candidates<Bodies>, kSolveThreads);
  for (const bool is_first : {true, false}) {
    if (!is_first && search.least == nullptr) break;
    solve_candidates<Bodies><<<blocks, kSolveThreads, 0, context.stream>>>(bodies, search, is_first);
    check_cuda(cudaGetLastError(), "solve_candidates");
  }
}

}  // namespace pgccd
