// The state of a search for contacts on a device: what the kernels of search_candidates.cuh hand to each other, and the
// memory for it.
#pragma once

#include "kernels/device.cuh"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/narrow_cuda.h"

namespace pgccd {

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
  uint32_t open;        // candidates that the quick phase leaves, those that did not fit included
  uint32_t patient;     // among them: those that the plain phase leaves
  uint32_t contacts;    // among them; of first toi: pairs that have one
  uint32_t unresolved;  // of the rows written
  uint32_t blocks_done;
  uint32_t unused;  // instead of padding, which would be copied unset
  int64_t rows;     // to report
};

struct OpenCandidate {
  double t, goal;  // the progress that the quick phase made, as the next
  int32_t advances;
  int32_t row;  // of the candidates
  int32_t pair;
  int32_t unused;  // instead of padding, which would be copied unset

  PGCCD_HD Progress<double> progress() const { return {t, goal, advances}; }
};

// Contacts, in any order; and per pair the earliest toi so far, unless all are to be reported.
struct Search {
  NarrowInput input;
  OpenCandidate* open;
  uint32_t* patient;             // rows of `open`
  uint32_t capacity;             // of both
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

// What is known when the search for the contact of an open candidate begins.
struct Prospect {
  double latest;   // a contact certainly later than that is of no interest
  bool is_needed;  // false: whether there is a contact is of no interest either
};

__device__ inline Prospect prospect_of(const Search& search, const OpenCandidate& open) {
  const unsigned long long best = search.best == nullptr ? ~0ull : search.best_of(open.pair);
  if (best == ~0ull) return {static_cast<double>(INFINITY), true};
  return {__longlong_as_double(static_cast<long long>(best)), search.input.report != Report::kAny};
}

// Searches that are cut short since their contacts would be later than the pair's best do not change which is first.
__device__ inline void report(const Search& search, const OpenCandidate& open, const Outcome<double>& outcome) {
  if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) return;
  if (search.best != nullptr) atomicMin(search.best + open.pair, toi_bits(outcome.toi));
  if (search.contacts == nullptr) return;
  // There are no more contacts than open candidates, so the capacity suffices.
  search.contacts[warp_append(&search.counters->contacts, 1)] = {open.row, static_cast<int32_t>(outcome.status),
                                                                 outcome.toi, outcome.u, outcome.v};
}

// `most_open`: candidates that the quick phase may leave.
inline Search make_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open) {
  Search search{};
  search.input = input;
  search.counters = context.allocate<SearchCounters>(1);
  search.capacity = static_cast<uint32_t>(smaller<int64_t>(most_open, 0x7ffffff0));
  search.open = context.allocate<OpenCandidate>(search.capacity);
  search.patient = context.allocate<uint32_t>(search.capacity);
  return search;
}

// Memory for the first contact of each pair known so far, and for its row where the report needs it. In one piece, so
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

}  // namespace pgccd
