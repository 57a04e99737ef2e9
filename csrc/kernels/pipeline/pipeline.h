// The order of stages: traversal and narrow phase of a step. On the CPU lists grow as needed, and only result rows can
// overflow. On a device all lists have given capacities, and nothing synchronises.
#pragma once

#include "kernels/narrow/narrow.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

struct ContactSearch {
  TraverseInput traversal{};
  NarrowInput narrow;
  const int64_t* pair_count = nullptr;  // number of valid pairs, in the memory of the pairs
  TraverseCapacity traverse_capacity{};
  ContactCapacity contact_capacity{};
  int64_t* traverse_counts = nullptr;  // (kTraverseCounts); the start time is set
  int64_t* contact_counts = nullptr;   // (kContactCounts)
};

// A copy of `count` values.
struct CountSpan {
  const int64_t* from;
  int64_t count;
  int64_t* to;
};

// Initialises the counts of a step: copies both spans and records the time.
void begin_counts(const Executor& executor, const CountSpan& first, const CountSpan& second, int64_t* time);
void begin_counts(const DeviceContext& context, const CountSpan& first, const CountSpan& second, int64_t* time);

// Contacts of body pairs in the given capacity, followed by padding.
template <class Bodies>
void find_contacts(const Executor& executor, const Bodies& bodies, const ContactSearch& search,
                   const ContactOutput& make_output);
template <class Bodies>
void find_contacts(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                   const ContactOutput& make_output);

// Lowers the first toi of the owners of each pair. Owners that are not there are an error.
void lower_first_toi(const Executor& executor, const RigidBodies& bodies, const ContactSearch& search,
                     const FirstToi& known);
void lower_first_toi(const DeviceContext& context, const RigidBodies& bodies, const ContactSearch& search,
                     const FirstToi& known);

}  // namespace pgccd
