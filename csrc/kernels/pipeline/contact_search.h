// Input of the search for contacts: traversal and narrow phase of a step.
#pragma once

#include "kernels/narrow/narrow.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

struct ContactSearch {
  TraverseInput traversal{};
  NarrowInput narrow;
  const int64_t* pair_count = nullptr;  // number of valid pairs, in the memory of the pairs
  bool only_earliest = false;           // of the first contacts, only the earliest of the scene is needed
  TraverseCapacity traverse_capacity{};
  ContactCapacity contact_capacity{};
  int64_t* traverse_counts = nullptr;  // (kTraverseCounts); the start time is set
  int64_t* contact_counts = nullptr;   // (kContactCounts)
};

}  // namespace pgccd
