// In which portions the leaf pairs of a body pair are searched for one contact on the CPU.
#pragma once

#include <cstddef>
#include <limits>

namespace pgccd {

// Leaf pairs of a body pair in the first batch; those of most pairs fit into it.
constexpr size_t kFirstBatch = 4;
// Leaf pairs near at t = 0 after which the first descent for any contact ends: bodies that intersect have hundreds.
constexpr size_t kFewAtStart = 16;
constexpr size_t kAllLeaves = std::numeric_limits<size_t>::max();

}  // namespace pgccd
