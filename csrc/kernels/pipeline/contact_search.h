// What the search for contacts is given: traversal and narrow phase of a step, one after the other.
#pragma once

#include "kernels/narrow/narrow.h"
#include "kernels/traverse/traverse.h"

namespace pgccd {

struct ContactSearch {
  TraverseInput traversal{};
  NarrowInput narrow;
  const int64_t* pair_count = nullptr;  // how many of the pairs given there are; where the pairs are
  bool only_earliest = false;           // of the first contacts only the earliest of all is wanted
  TraverseCapacity traverse_capacity{};
  ContactCapacity contact_capacity{};
  int64_t* traverse_counts = nullptr;  // (kTraverseCounts), of which the time of the beginning is set
  int64_t* contact_counts = nullptr;   // (kContactCounts)
};

}  // namespace pgccd
