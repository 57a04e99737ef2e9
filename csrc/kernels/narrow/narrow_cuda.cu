#include <cub/cub.cuh>

#include "kernels/device.cuh"
#include "kernels/narrow/contact_item.h"
#include "kernels/narrow/narrow_cuda.h"

namespace pgccd {
namespace {

// Long searches, spread over many multiprocessors.
constexpr int kSolveThreads = 64;

struct FoundContact {
  int32_t candidate;
  int32_t status;
  double toi, u, v;
};

struct Counters {
  uint32_t open;        // candidates that are not free at a glance, those that did not fit included
  uint32_t contacts;    // among them; of first toi: pairs that have one
  uint32_t unresolved;  // of the rows written
  uint32_t blocks_done;
  int64_t rows;  // to report
};

// Contacts, in any order; and per pair the earliest toi so far, unless all are to be reported.
struct Search {
  NarrowInput input;
  int32_t* open;  // rows of the candidates
  uint32_t capacity;
  FoundContact* contacts;        // or null, as the next three
  unsigned long long* best;      // bits of the toi
  unsigned long long* best_key;  // as the next, to choose among equal ones
  int32_t* winner;               // the contact
  Counters* counters;

  __device__ bool has_contact(int64_t contact) const { return contact < static_cast<int64_t>(counters->contacts); }
  __device__ const Candidate& candidate(uint32_t contact) const {
    return input.candidates.items[contacts[contact].candidate];
  }
};

// toi >= 0, so its bits are in order; all ones is later than any.
__device__ unsigned long long toi_bits(double toi) {
  return static_cast<unsigned long long>(__double_as_longlong(toi));
}

// Kind and features in canonical order.
__device__ unsigned long long feature_key(const Candidate& c) {
  return (static_cast<unsigned long long>(c.kind) << 62) | (static_cast<unsigned long long>(c.feature_i) << 31) |
         static_cast<unsigned long long>(c.feature_j);
}

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
    if (free_at_a_glance(bodies, pair_of(bodies, search.input, candidate), candidate, search.input.settings)) continue;
    const uint32_t at = warp_append(&search.counters->open, 1);
    if (at < search.capacity) search.open[at] = static_cast<int32_t>(c);
  }
}

// One thread an open candidate. Those certainly later than the pair's best so far are cut short, which cannot change
// the winner.
template <class Bodies>
__global__ void __launch_bounds__(kSolveThreads, 6) solve_candidates(Bodies bodies, Search search) {
  const uint32_t count = smaller(search.counters->open, search.capacity);
  const uint32_t stride = gridDim.x * blockDim.x;
  for (uint32_t item = blockIdx.x * blockDim.x + threadIdx.x; item < count; item += stride) {
    const int32_t c = search.open[item];
    const Candidate candidate = search.input.candidates.items[c];
    double latest = INFINITY;
    if (search.best != nullptr) {
      const unsigned long long seen = *static_cast<volatile unsigned long long*>(search.best + candidate.pair);
      if (seen != ~0ull) {
        if (search.input.report == Report::kAny) continue;
        latest = __longlong_as_double(static_cast<long long>(seen));
      }
    }
    const auto pair = pair_of(bodies, search.input, candidate);
    const Outcome<double> outcome = solve_candidate(bodies, pair, candidate, search.input.settings, latest);
    if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) continue;
    if (search.best != nullptr) atomicMin(search.best + candidate.pair, toi_bits(outcome.toi));
    if (search.contacts == nullptr) continue;
    // No more contacts than open candidates: there is room.
    search.contacts[warp_append(&search.counters->contacts, 1)] = {c, static_cast<int32_t>(outcome.status), outcome.toi,
                                                                   outcome.u, outcome.v};
  }
}

// One thread a pair.
__global__ void __launch_bounds__(kBlockThreads) lower_owners(Search search, FirstToi known, int64_t* counts) {
  Counters& seen = *search.counters;
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const unsigned long long toi = pair < search.input.pair_count ? search.best[pair] : ~0ull;
  if (toi != ~0ull) {
    warp_append(&seen.contacts, 1);
    for (int side = 0; side < 2; ++side) {
      atomicMin(reinterpret_cast<unsigned long long*>(known.first + known.owners[2 * pair + side]), toi);
    }
  }
  __syncthreads();
  if (threadIdx.x != 0 || !is_last_block(&seen.blocks_done)) return;
  counts[kOpenNeeded] = seen.open;
  counts[kContactsNeeded] = atomicAdd(&seen.contacts, 0u);
  counts[kUnresolvedWritten] = 0;
  counts[kContactsOverflow] = seen.open > search.capacity;
  counts[kNarrowEnded] = nanoseconds();
}

// The contacts to report, in canonical order: one a pair.
int32_t* select_first(const DeviceContext& context, const Search& search) {
  const int64_t pair_count = search.input.pair_count;
  for_each_counted(context, &search.counters->contacts, search.capacity, [=] __device__(int64_t k) {
    const Candidate& c = search.candidate(k);
    if (toi_bits(search.contacts[k].toi) == search.best[c.pair]) atomicMin(search.best_key + c.pair, feature_key(c));
  });
  for_each_counted(context, &search.counters->contacts, search.capacity, [=] __device__(int64_t k) {
    const Candidate& c = search.candidate(k);
    if (toi_bits(search.contacts[k].toi) == search.best[c.pair] && feature_key(c) == search.best_key[c.pair]) {
      search.winner[c.pair] = static_cast<int32_t>(k);
    }
  });
  int32_t* selected = context.allocate<int32_t>(pair_count);
  const auto has_winner = [] __device__(int32_t k) { return k >= 0; };
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceSelect::If(scratch, bytes, search.winner, selected, &search.counters->rows, pair_count,
                                 has_winner, context.stream);
  });
  return selected;
}

// The first `count` of them, or all there are if that is less, sorted by pair, kind and features: two stable sorts, the
// less significant key first.
int32_t* sort_all(const DeviceContext& context, const Search& search, int64_t count) {
  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted_keys = context.allocate<uint64_t>(count);
  int32_t* order = context.allocate<int32_t>(count);
  int32_t* sorted_order = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    keys[k] = search.has_contact(k) ? feature_key(search.candidate(k)) : ~uint64_t{0};  // after all others
    order[k] = static_cast<int32_t>(k);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, order, sorted_order, count, 0, 64,
                                           context.stream);
  });
  for_each_item(context, count, [=] __device__(int64_t k) {
    const int32_t contact = sorted_order[k];
    keys[k] = search.has_contact(contact) ? static_cast<uint64_t>(search.candidate(contact).pair) : ~uint64_t{0};
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, sorted_order, order, count, 0, 32,
                                           context.stream);
  });
  for_each_item(context, 1, [=] __device__(int64_t) { search.counters->rows = search.counters->contacts; });
  return order;
}

// To all rows of `out`: contacts, then padding.
template <class Bodies>
void write_rows(const DeviceContext& context, const Bodies& bodies, const Search& search, const int32_t* selected,
                int64_t rows, const ContactColumns& out) {
  for_each_item(context, rows, [=] __device__(int64_t row) {
    if (row >= search.counters->rows) return pad_row(out, row);
    const FoundContact& contact = search.contacts[selected[row]];
    const Candidate c = search.input.candidates.items[contact.candidate];
    const auto pair = pair_of(bodies, search.input, c);
    const ContactPlace at = contact_place(bodies, pair, c, contact.toi, contact.u, contact.v);
    if (out.pair != nullptr) out.pair[row] = c.pair;
    if (out.bodies != nullptr) {
      for (int side = 0; side < 2; ++side) out.bodies[2 * row + side] = search.input.pairs[2 * int64_t{c.pair} + side];
    }
    out.kind[row] = static_cast<int8_t>(c.kind);
    out.features[2 * row] = c.feature_i;
    out.features[2 * row + 1] = c.feature_j;
    out.status[row] = static_cast<int8_t>(contact.status);
    out.toi[row] = contact.toi;
    out.coordinates[2 * row] = contact.u;
    out.coordinates[2 * row + 1] = contact.v;
    store_vec3(out.point + 3 * row, at.point);
    store_vec3(out.normal + 3 * row, at.normal);
    if (contact.status == static_cast<int32_t>(Status::kUnresolved)) atomicAdd(&search.counters->unresolved, 1u);
  });
}

// `most_open`: candidates that need more than a glance.
Search make_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open) {
  Search search{};
  search.input = input;
  search.counters = context.allocate<Counters>(1);
  search.capacity = static_cast<uint32_t>(smaller<int64_t>(most_open, 0x7ffffff0));
  search.open = context.allocate<int32_t>(search.capacity);
  return search;
}

Search make_search_for_contacts(const DeviceContext& context, const NarrowInput& input, int64_t most_open) {
  Search search = make_search(context, input, most_open);
  if (input.report != Report::kAll) {
    // In one piece, so that one launch fills all three.
    search.best = context.allocate<unsigned long long>(2 * input.pair_count + (input.pair_count + 1) / 2);
    search.best_key = search.best + input.pair_count;
    search.winner = reinterpret_cast<int32_t*>(search.best_key + input.pair_count);
  }
  search.contacts = context.allocate<FoundContact>(search.capacity);
  return search;
}

template <class Bodies>
void run_search(const DeviceContext& context, const Bodies& bodies, const Search& search) {
  const int64_t pairs = search.input.pair_count;
  // No toi, no key and no winner yet, as words of eight bytes.
  const int64_t words = search.best == nullptr ? 0 : search.winner == nullptr ? pairs : 2 * pairs + (pairs + 1) / 2;
  for_each_item(context, larger<int64_t>(1, words), [=] __device__(int64_t k) {
    if (k == 0) *search.counters = {};
    if (k < words) search.best[k] = ~0ull;
  });
  if (pairs == 0) return;
  glance_at_candidates<Bodies>
      <<<resident_blocks_of(glance_at_candidates<Bodies>), kBlockThreads, 0, context.stream>>>(bodies, search);
  check_cuda(cudaGetLastError(), "glance_at_candidates");
  solve_candidates<Bodies>
      <<<resident_blocks_of(solve_candidates<Bodies>, kSolveThreads), kSolveThreads, 0, context.stream>>>(bodies,
                                                                                                          search);
  check_cuda(cudaGetLastError(), "solve_candidates");
}

}  // namespace

template <class Bodies>
void narrow_phase_cuda(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                       const ContactOutput& make_output) {
  if (input.candidates.size == 0 || input.pair_count == 0) {
    make_output(0);
    return;
  }
  const bool one_a_pair = input.report != Report::kAll;
  // About one in four is open; all of them may be.
  int64_t capacity = smaller<int64_t>(input.candidates.size, input.candidates.size / 2 + 65536);
  for (;;) {
    const Search search = make_search_for_contacts(context, input, capacity);
    run_search(context, bodies, search);
    const int32_t* selected = one_a_pair ? select_first(context, search) : nullptr;
    const Counters seen = read(context, search.counters);
    if (seen.open > search.capacity) {
      capacity = seen.open;
      continue;
    }
    const int64_t rows = one_a_pair ? seen.rows : seen.contacts;
    const ContactColumns out = make_output(rows);
    if (rows == 0) return;
    if (!one_a_pair) selected = sort_all(context, search, seen.contacts);
    return write_rows(context, bodies, search, selected, rows, out);
  }
}

template <class Bodies>
void narrow_phase_within(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                         const ContactCapacity& capacity, const ContactColumns& out, int64_t* counts) {
  const Search search = make_search_for_contacts(context, input, capacity.open);
  run_search(context, bodies, search);
  const int32_t* selected = nullptr;
  if (input.pair_count > 0 && search.capacity > 0) {
    selected = search.best != nullptr ? select_first(context, search) : sort_all(context, search, search.capacity);
  }
  write_rows(context, bodies, search, selected, capacity.contacts, out);
  const Counters* seen = search.counters;
  for_each_item(context, 1, [=] __device__(int64_t) {
    counts[kOpenNeeded] = seen->open;
    counts[kContactsNeeded] = seen->rows;
    counts[kUnresolvedWritten] = seen->unresolved;
    counts[kContactsOverflow] = seen->open > search.capacity || seen->rows > capacity.contacts;
    counts[kNarrowEnded] = nanoseconds();
  });
}

template <class Bodies>
void lower_first_toi(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input, int64_t most_open,
                     const FirstToi& known, int64_t* counts) {
  Search search = make_search(context, input, most_open);
  search.best = context.allocate<unsigned long long>(input.pair_count);
  run_search(context, bodies, search);
  const int64_t blocks = larger<int64_t>(1, (input.pair_count + kBlockThreads - 1) / kBlockThreads);
  lower_owners<<<static_cast<unsigned>(blocks), kBlockThreads, 0, context.stream>>>(search, known, counts);
  check_cuda(cudaGetLastError(), "lower_owners");
}

template void lower_first_toi(const DeviceContext&, const RigidBodies&, const NarrowInput&, int64_t, const FirstToi&,
                              int64_t*);
template void narrow_phase_within(const DeviceContext&, const RigidBodies&, const NarrowInput&, const ContactCapacity&,
                                  const ContactColumns&, int64_t*);
template void narrow_phase_within(const DeviceContext&, const DeformingBodies&, const NarrowInput&,
                                  const ContactCapacity&, const ContactColumns&, int64_t*);
template void narrow_phase_cuda(const DeviceContext&, const RigidBodies&, const NarrowInput&, const ContactOutput&);
template void narrow_phase_cuda(const DeviceContext&, const DeformingBodies&, const NarrowInput&, const ContactOutput&);

template <bool kEdgeEdge, class T>
void elementary_cuda(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                     const NarrowSettings& settings, const ElementaryColumns<T>& out) {
  for_each_item(context, count, [=] __device__(int64_t q) {
    const T *start = points_t0 + 12 * q, *end = points_t1 + 12 * q;
    const bool free = stays_apart(rounded_differences<kEdgeEdge>(start), rounded_differences<kEdgeEdge>(end),
                                  cull_distance(settings), kEdgeEdge);
    store(out, q, free ? culled_answer<T>() : solve_elementary<kEdgeEdge>(start, end, settings));
  });
}

template void elementary_cuda<false>(const DeviceContext&, const float*, const float*, int64_t, const NarrowSettings&,
                                     const ElementaryColumns<float>&);
template void elementary_cuda<true>(const DeviceContext&, const float*, const float*, int64_t, const NarrowSettings&,
                                    const ElementaryColumns<float>&);
template void elementary_cuda<false>(const DeviceContext&, const double*, const double*, int64_t, const NarrowSettings&,
                                     const ElementaryColumns<double>&);
template void elementary_cuda<true>(const DeviceContext&, const double*, const double*, int64_t, const NarrowSettings&,
                                    const ElementaryColumns<double>&);

}  // namespace pgccd
