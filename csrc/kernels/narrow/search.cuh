// State of a search for contacts on a device, shared by the kernels of search_candidates.cuh, and its memory.
#pragma once

#include "kernels/device.cuh"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {

// toi >= 0, so its bits have the same order; all ones is later than any toi.
__device__ inline unsigned long long toi_bits(double toi) {
  return static_cast<unsigned long long>(__double_as_longlong(toi));
}

struct FoundContact {
  int32_t candidate;
  int32_t status;
  double toi;
};

struct SearchCounters {
  uint32_t open;         // candidates left by the quick phase, including those beyond the capacity
  uint32_t open_before;  // those of them of the first of two parts, once it has ended
  uint32_t patient;      // those of them left by the plain phase
  uint32_t contacts;     // contacts, including those beyond the capacity; for first toi only, pairs with a contact
  uint32_t unresolved;   // rows with status unresolved
  uint32_t blocks_done;
  int64_t rows;  // number of rows to report

  // Capacity needed: what the bodies at t = 0 decide are contacts, but were no open candidates.
  PGCCD_HD uint32_t needed() const { return larger(open, contacts); }
};

struct OpenCandidate {
  double t, goal;  // with `advances`: the progress of the quick phase
  int32_t advances;
  int32_t row;  // index of the candidate
  int32_t pair;
  int32_t unused;  // explicit padding, so that no uninitialised bytes are copied

  PGCCD_HD Progress<double> progress() const { return {t, goal, advances}; }
};

// Contacts, unsorted; and per pair the earliest toi so far, unless all are reported.
struct Search {
  NarrowInput input;
  OpenCandidate* open;
  uint32_t* patient;             // indices into `open`
  uint32_t capacity;             // of these and of `contacts`
  FoundContact* contacts;        // null if no contacts are written; so may be the next four
  unsigned long long* best;      // bits of the toi
  unsigned long long* least;     // bits of the time before which no open candidate of the pair can touch
  unsigned long long* best_key;  // with `winner`: chooses among contacts with equal toi
  int32_t* winner;               // index of the contact
  int64_t words;                 // of eight bytes: size of these four arrays
  SearchCounters* counters;

  __device__ bool has_contact(int64_t contact) const { return contact < static_cast<int64_t>(counters->contacts); }
  __device__ const Candidate& candidate(uint32_t contact) const {
    return input.candidates.items[contacts[contact].candidate];
  }
  __device__ unsigned long long best_of(int32_t pair) const {
    return *static_cast<const volatile unsigned long long*>(best + pair);
  }
};

// Bounds for the search of an open candidate, from earlier contacts of its pair.
struct Prospect {
  double latest;   // certainly later contacts are dropped
  bool is_needed;  // false: the candidate need not be solved at all
};

__device__ inline Prospect prospect_of(const Search& search, int32_t pair) {
  const unsigned long long best = search.best == nullptr ? ~0ull : search.best_of(pair);
  if (best == ~0ull) return {static_cast<double>(INFINITY), true};
  return {__longlong_as_double(static_cast<long long>(best)), search.input.report != Report::kAny};
}

// Searches pruned because their contacts would be later than the pair's best do not change the first contact.
__device__ inline void report(const Search& search, int32_t row, int32_t pair, const Outcome<double>& outcome) {
  if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) return;
  if (search.best != nullptr) atomicMin(search.best + pair, toi_bits(outcome.toi));
  if (search.contacts == nullptr) return;
  const uint32_t at = warp_append(&search.counters->contacts);
  if (at >= search.capacity) return;
  search.contacts[at] = {row, static_cast<int32_t>(outcome.status), outcome.toi};
}

}  // namespace pgccd
