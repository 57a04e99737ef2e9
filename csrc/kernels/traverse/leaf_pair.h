// Pairs of leaves passed from the descent to the search of their triangles.
#pragma once

#include "kernels/traverse/pair_item.h"

namespace pgccd {

// A pair of leaves of one row of the body pairs.
struct alignas(16) LeafPair {
  int32_t pair;
  NodePair leaves;
  float begin;  // the leaves certainly stay apart before it
};

}  // namespace pgccd
