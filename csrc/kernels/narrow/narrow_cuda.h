// Narrow phase on the device.
#pragma once

#include "kernels/device_context.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {

template <class Bodies>
void narrow_phase_cuda(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                       const ContactOutput& make_output);

// A narrow phase that does not synchronise, of candidates that come in one or two parts; see search.cuh. `most_open`:
// capacity for candidates left by the quick phase. Without contacts, only the first toi of each pair is found.
struct Search;
Search new_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open, bool with_contacts);

template <class Bodies>
void search_candidates(const DeviceContext& context, const Bodies& bodies, Search& search,
                       const CandidateSpan& candidates, bool is_last);

// Unused rows of `out` are filled: pair and features -1, toi infinite, the rest 0.
template <class Bodies>
void write_contacts(const DeviceContext& context, const Bodies& bodies, const Search& search, int64_t most,
                    const ContactColumns& out, int64_t* counts);

// Lowers the first toi of the owners of each pair. kContactsNeeded counts pairs with a contact; unresolved ones are not
// counted separately.
void lower_first_toi(const DeviceContext& context, const Search& search, const FirstToi& known, int64_t* counts);

template <bool kEdgeEdge, class T>
void elementary_cuda(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                     const NarrowSettings& settings, const ElementaryColumns<T>& out);

}  // namespace pgccd
