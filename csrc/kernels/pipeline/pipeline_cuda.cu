#include "kernels/launch.cuh"
#include "kernels/narrow/search.cuh"
#include "kernels/pipeline/pipeline.h"

namespace pgccd {
namespace {

// Traversal and narrow phase. If one contact of each pair is wanted, possibly in two parts: see SearchFirstPart. The
// result is the same.
template <class Bodies>
Search search_pairs(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                    bool with_contacts) {
  Search narrow = new_search(context, search.narrow, search.contact_capacity.open, with_contacts);
  SearchFirstPart search_first_part;
  if (search.narrow.report != Report::kAll) {
    search_first_part = [&](const CandidateSpan& candidates) {
      search_candidates(context, bodies, narrow, candidates, false);
      return first_part_of(context, narrow, search.traverse_capacity.crowded);
    };
  }
  const CandidateSpan candidates = traverse_padded(context, bodies, search.traversal, search.pair_count,
                                                   search.traverse_capacity, search.traverse_counts, search_first_part);
  search_candidates(context, bodies, narrow, candidates, true);
  return narrow;
}

}  // namespace

void begin_counts(const DeviceContext& context, const CountSpan& first, const CountSpan& second, int64_t* time) {
  // A single launch: a separate copy would take the host as long.
  for_each_item(context, first.count + second.count + 1, [=] __device__(int64_t k) {
    if (k == 0) *time = nanoseconds();
    if (k < first.count) first.to[k] = first.from[k];
    const int64_t other = k - first.count;
    if (other >= 0 && other < second.count) second.to[other] = second.from[other];
  });
}

template <class Bodies>
void find_contacts(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                   const ContactOutput& make_output) {
  const Search found = search_pairs(context, bodies, search, true);
  const int64_t most = search.contact_capacity.contacts;
  write_contacts(context, bodies, found, most, make_output(most), search.contact_counts);
}

void lower_first_toi(const DeviceContext& context, const RigidBodies& bodies, const ContactSearch& search,
                     const FirstToi& known) {
  for_each_counted(context, search.pair_count, search.narrow.pair_count, [=] __device__(int64_t pair) {
    require_on_device(
        is_within(known.owners[2 * pair], known.count) && is_within(known.owners[2 * pair + 1], known.count),
        "owners: expected rows of first");
  });
  write_first_toi(context, search_pairs(context, bodies, search, false), known, search.contact_counts);
}

template void find_contacts(const DeviceContext&, const RigidBodies&, const ContactSearch&, const ContactOutput&);
template void find_contacts(const DeviceContext&, const DeformingBodies&, const ContactSearch&, const ContactOutput&);

}  // namespace pgccd
