#include "kernels/narrow/search.cuh"
#include "kernels/pipeline/pipeline_cuda.h"
#include "kernels/traverse/traverse_cuda.h"

namespace pgccd {
namespace {

// With fewer body pairs, two parts take longer than one: every launch has a minimum duration.
constexpr int64_t kManyPairs = 1 << 18;

// Traversal and narrow phase. If one contact of each of many pairs is wanted, in two parts: the second only needs to
// consider the motion until the contacts found in the first. The result is the same.
template <class Bodies>
Search find_contacts(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                     bool with_contacts) {
  Search narrow = new_search(context, search.narrow, search.contact_capacity.open, with_contacts);
  SearchFirstPart search_first_part;
  if (search.narrow.report != Report::kAll && search.traversal.pair_count >= kManyPairs) {
    search_first_part = [&](const CandidateSpan& candidates) {
      search_candidates(context, bodies, narrow, candidates, false);
      return narrow.best;
    };
  }
  const CandidateSpan candidates = traverse_padded(context, bodies, search.traversal, search.pair_count,
                                                   search.traverse_capacity, search.traverse_counts, search_first_part);
  search_candidates(context, bodies, narrow, candidates, true);
  return narrow;
}

}  // namespace

template <class Bodies>
void find_contacts_cuda(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                        const ContactOutput& make_output) {
  const Search found = find_contacts(context, bodies, search, true);
  const int64_t most = search.contact_capacity.contacts;
  write_contacts(context, bodies, found, most, make_output(most), search.contact_counts);
}

void lower_first_toi_cuda(const DeviceContext& context, const RigidBodies& bodies, const ContactSearch& search,
                          const FirstToi& known) {
  lower_first_toi(context, find_contacts(context, bodies, search, false), known, search.contact_counts);
}

template void find_contacts_cuda(const DeviceContext&, const RigidBodies&, const ContactSearch&, const ContactOutput&);
template void find_contacts_cuda(const DeviceContext&, const DeformingBodies&, const ContactSearch&,
                                 const ContactOutput&);

}  // namespace pgccd
