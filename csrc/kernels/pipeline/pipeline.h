// The order of stages on the CPU, where lists grow as needed: only result rows can overflow.
#pragma once

#include "kernels/begin_counts.h"
#include "kernels/broad/broad.h"
#include "kernels/executor.h"
#include "kernels/padded_pairs.h"
#include "kernels/pipeline/contact_search.h"

namespace pgccd {

// Copies both spans and records the time.
void begin_counts_cpu(const CountSpan& first, const CountSpan& second, int64_t* time);

// The PCS in a buffer of fixed capacity; none if the bodies are invalid.
void find_pairs_padded_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                           const PaddedPairs& out);

// The PCS in a buffer of its exact size; empty if the bodies are invalid, or if there are more than `most` pairs.
void find_pairs_exactly_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                            int64_t most, const PairOutput& make_output, int64_t* counts);

// Contacts of body pairs in the given capacity, followed by padding.
template <class Bodies>
void find_contacts_cpu(const Executor& executor, const Bodies& bodies, const ContactSearch& search,
                       const ContactOutput& make_output);

// Lowers the first toi of the owners of each pair.
void lower_first_toi_cpu(const Executor& executor, const RigidBodies& bodies, const ContactSearch& search,
                         const FirstToi& known);

}  // namespace pgccd
