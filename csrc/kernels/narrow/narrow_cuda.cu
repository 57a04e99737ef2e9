#include <bit>
#include <cub/cub.cuh>

#include "kernels/launch.cuh"
#include "kernels/narrow/contact_item.h"
#include "kernels/narrow/narrow.h"
#include "kernels/narrow/search_candidates.cuh"

namespace pgccd {
namespace {

constexpr int kMostFeatureBits = 30;
constexpr int kKindBits = 3;
static_assert(kFeatureKinds <= 1 << kKindBits && 2 * kMostFeatureBits + kKindBits < 64);

// Sort key of kind and features, which are below 2^bits, in canonical order.
__device__ unsigned long long feature_key(const Candidate& c, int bits = kMostFeatureBits) {
  return (static_cast<unsigned long long>(c.kind) << (2 * bits)) |
         (static_cast<unsigned long long>(c.feature_i) << bits) | static_cast<unsigned long long>(c.feature_j);
}

// Memory for the first contact of each pair, and for its row if needed by the report. One allocation, so that one
// launch initialises all.
void allocate_first(const DeviceContext& context, Search& search, bool with_winner) {
  const int64_t pairs = search.input.pair_count;
  search.words = with_winner ? 3 * pairs + (pairs + 1) / 2 : 2 * pairs;
  search.best = context.allocate<unsigned long long>(search.words);
  search.least = search.best + pairs;
  if (!with_winner) return;
  search.best_key = search.least + pairs;
  search.winner = reinterpret_cast<int32_t*>(search.best_key + pairs);
}

// One thread per pair.
__global__ void __launch_bounds__(kBlockThreads) lower_owners(Search search, FirstToi known, int64_t* counts) {
  wait_for_previous_kernels();
  SearchCounters& seen = *search.counters;
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const unsigned long long toi = pair < search.input.pair_count ? search.best[pair] : ~0ull;
  if (toi != ~0ull) {
    warp_append(&seen.contacts);
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

// A type, not a lambda: the library asks on the host for the type of the result, which a device lambda does not tell.
struct HasWinner {
  __host__ __device__ bool operator()(int32_t winner) const { return winner >= 0; }
};

// The contacts to report in canonical order, one per pair.
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
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceSelect::If(scratch, bytes, search.winner, selected, &search.counters->rows, pair_count,
                                 HasWinner{}, context.stream);
  });
  return selected;
}

// All contacts, sorted by pair, kind and features: two stable sorts, the less significant key first. Each sort takes
// one pass per eight bits, so only the bits that differ are sorted. Rows without a contact have larger keys than all
// others.
int32_t* sort_all(const DeviceContext& context, int64_t feature_count, const Search& search) {
  const int64_t count = search.capacity, pair_count = search.input.pair_count;
  // Features have numbers within their meshes, whose rows may be more in all.
  const int feature_bits =
      smaller(static_cast<int>(std::bit_width(static_cast<uint64_t>(feature_count))), kMostFeatureBits);
  const int pair_bits = std::bit_width(static_cast<uint64_t>(pair_count));
  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted_keys = context.allocate<uint64_t>(count);
  int32_t* order = context.allocate<int32_t>(count);
  int32_t* sorted_order = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    keys[k] = search.has_contact(k) ? feature_key(search.candidate(k), feature_bits) : ~uint64_t{0};
    order[k] = static_cast<int32_t>(k);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, order, sorted_order, count, 0,
                                           2 * feature_bits + kKindBits, context.stream);
  });
  for_each_item(context, count, [=] __device__(int64_t k) {
    const int32_t contact = sorted_order[k];
    keys[k] = static_cast<uint64_t>(search.has_contact(contact) ? search.candidate(contact).pair : pair_count);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, sorted_order, order, count, 0, pair_bits,
                                           context.stream);
  });
  for_each_item(context, 1, [=] __device__(int64_t) {
    search.counters->rows = smaller(search.counters->contacts, search.capacity);
  });
  return order;
}

struct SelectedContacts {
  Search search;
  const int32_t* rows;  // indices into search.contacts, in canonical order; null if there are none
};

// Writes all rows of `out`: contacts, then padding.
template <class Bodies>
void write_rows(const DeviceContext& context, const Bodies& bodies, const SelectedContacts& selected, int64_t rows,
                const ContactColumns& out) {
  const Search& search = selected.search;
  const int32_t* order = selected.rows;
  for_each_item(context, rows, [=] __device__(int64_t row) {
    if (row >= search.counters->rows) return pad_row(out, row);
    const FoundContact& contact = search.contacts[order[row]];
    const Candidate c = search.input.candidates.items[contact.candidate];
    const auto pair = pair_of(bodies, search.input, c);
    const ContactPlace at = contact_place(bodies, pair, c, contact.toi);
    if (out.pair != nullptr) out.pair[row] = c.pair;
    if (out.bodies != nullptr) {
      for (int side = 0; side < 2; ++side) out.bodies[2 * row + side] = search.input.pairs[2 * int64_t{c.pair} + side];
    }
    store_contact(out, row, c, contact, at);
    if (contact.status == static_cast<int32_t>(Status::kUnresolved)) atomicAdd(&search.counters->unresolved, 1u);
  });
}

// Does not synchronise: `rows` of the search's counters is the number of contacts, if all open candidates fit.
SelectedContacts select_contacts(const DeviceContext& context, int64_t feature_count, const Search& search) {
  if (search.input.pair_count == 0 || search.capacity == 0) return {search, nullptr};
  return {search, search.best != nullptr ? select_first(context, search) : sort_all(context, feature_count, search)};
}

template <class Bodies>
void require_sound(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input) {
  const CandidateSpan candidates = input.candidates;
  const int64_t* const pairs = input.pairs;
  const int64_t pair_count = input.pair_count;
  if (candidates.size == 0) return;
  int32_t* is_unsound = context.allocate<int32_t>(1);
  fill_bytes(context, is_unsound, 0, 1);
  for_each_item(context, candidates.size, [=] __device__(int64_t k) {
    if (!names_features(bodies, pairs, pair_count, candidates.items[k])) *is_unsound = 1;
  });
  if (read(context, is_unsound) != 0) {
    throw std::invalid_argument("candidates: expected rows that name pairs, kinds and features that are there");
  }
}

}  // namespace

Search new_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open, bool with_contacts) {
  Search search{};
  search.input = input;
  search.counters = context.allocate<SearchCounters>(1);
  search.capacity = static_cast<uint32_t>(smaller<int64_t>(most_open, 0x7ffffff0));
  search.open = context.allocate<OpenCandidate>(search.capacity);
  search.patient = context.allocate<uint32_t>(search.capacity);
  if (input.report != Report::kAll) allocate_first(context, search, with_contacts);
  if (with_contacts) search.contacts = context.allocate<FoundContact>(search.capacity);
  // Initialises toi, keys and winners.
  for_each_item(context, larger<int64_t>(1, search.words), [=] __device__(int64_t k) {
    if (k == 0) *search.counters = {};
    if (k < search.words) search.best[k] = ~0ull;
  });
  return search;
}

template <class Bodies>
void narrow_phase(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                  const ContactOutput& make_output) {
  require_sound(context, bodies, input);
  if (input.candidates.size == 0 || input.pair_count == 0) {
    make_output(0);
    return;
  }
  // Initial estimate: about one in four is open; all of them may be.
  int64_t capacity = smaller<int64_t>(input.candidates.size, input.candidates.size / 2 + 65536);
  for (;;) {
    Search search = new_search(context, input, capacity, true);
    search_candidates(context, bodies, search, input.candidates, true);
    const SelectedContacts selected = select_contacts(context, bodies.meshes.feature_count, search);
    const SearchCounters seen = read(context, selected.search.counters);
    if (seen.needed() <= selected.search.capacity) {
      return write_rows(context, bodies, selected, seen.rows, make_output(seen.rows));
    }
    capacity = seen.needed();
  }
}

template <class Bodies>
void search_candidates(const DeviceContext& context, const Bodies& bodies, Search& search,
                       const CandidateSpan& candidates, bool is_last) {
  if (search.input.pair_count == 0) return;
  search.input.candidates = candidates;
  if (search.input.may_have_starts) launch_starts(context, bodies, search);
  launch_quickly(context, bodies, search);
  launch_plainly(context, bodies, search);
  is_last ? launch_patiently(context, bodies, search) : end_first_part(context, search);
}

FirstPart first_part_of(const DeviceContext& context, const Search& search, bool with_features) {
  const bool any_will_do = search.input.report == Report::kAny;
  if (!with_features || any_will_do || search.contacts == nullptr) return {search.best, any_will_do, nullptr};
  const int64_t pair_count = search.input.pair_count;
  FirstFeature* known = context.allocate<FirstFeature>(pair_count);
  for_each_item(context, pair_count, [=] __device__(int64_t pair) { known[pair] = kNoFeature; });
  for_each_counted(context, &search.counters->contacts, search.capacity, [=] __device__(int64_t k) {
    const Candidate& c = search.candidate(k);
    if (search.contacts[k].toi > 0.0) return;
    atomicMin(reinterpret_cast<long long*>(known + c.pair),
              static_cast<long long>(first_feature(static_cast<FeatureKind>(c.kind), c.feature_i)));
  });
  return {search.best, false, known};
}

template <class Bodies>
void write_contacts(const DeviceContext& context, const Bodies& bodies, const Search& search, int64_t most,
                    const ContactColumns& out, int64_t* counts) {
  write_rows(context, bodies, select_contacts(context, bodies.meshes.feature_count, search), most, out);
  const SearchCounters* seen = search.counters;
  for_each_item(context, 1, [=] __device__(int64_t) {
    counts[kOpenNeeded] = seen->needed();
    counts[kContactsNeeded] = seen->rows;
    counts[kUnresolvedWritten] = seen->unresolved;
    counts[kContactsOverflow] = seen->needed() > search.capacity || seen->rows > most;
    counts[kNarrowEnded] = nanoseconds();
  });
}

void write_first_toi(const DeviceContext& context, const Search& search, const FirstToi& known, int64_t* counts) {
  const int64_t blocks = larger<int64_t>(1, (search.input.pair_count + kBlockThreads - 1) / kBlockThreads);
  launch_kernel(context, lower_owners, static_cast<unsigned>(blocks), kBlockThreads, search, known, counts);
}

template void search_candidates(const DeviceContext&, const RigidBodies&, Search&, const CandidateSpan&, bool);
template void search_candidates(const DeviceContext&, const DeformingBodies&, Search&, const CandidateSpan&, bool);
template void write_contacts(const DeviceContext&, const RigidBodies&, const Search&, int64_t, const ContactColumns&,
                             int64_t*);
template void write_contacts(const DeviceContext&, const DeformingBodies&, const Search&, int64_t,
                             const ContactColumns&, int64_t*);
template void narrow_phase(const DeviceContext&, const RigidBodies&, const NarrowInput&, const ContactOutput&);
template void narrow_phase(const DeviceContext&, const DeformingBodies&, const NarrowInput&, const ContactOutput&);

}  // namespace pgccd
