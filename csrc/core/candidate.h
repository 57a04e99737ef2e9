// Feature pairs passed from the traversal to the narrow phase.
#pragma once

#include <cstdint>

#include "core/counter.h"

namespace pgccd {

// Kinds for a body pair (i, j), i < j. The numeric order is the canonical order of contacts with equal toi.
enum class FeatureKind : int32_t {
  kVertexFace = 0,  // vertex of i, face of j
  kFaceVertex = 1,  // vertex of j, face of i
  kEdgeEdge = 2,    // edge of i, edge of j
};

struct Candidate {
  int32_t pair;  // index into the list of body pairs
  int32_t kind;  // FeatureKind
  int32_t feature_i;
  int32_t feature_j;
};

// Candidates in memory: `size` of them, or, if the host has not read the device's counts, some at the front and some at
// the back of a buffer of `size`.
struct CandidateSpan {
  const Candidate* items = nullptr;
  int64_t size = 0;
  const Counter* front = nullptr;  // null: all `size` are valid
  const Counter* back = nullptr;

  // Zero on overflow, when front and back may overlap.
  PGCCD_HD int64_t count() const {
    if (front == nullptr) return size;
    const Counter counted = *front + *back;
    return fits(counted, size) ? static_cast<int64_t>(counted) : 0;
  }
  // Index of the k-th of `count()`.
  PGCCD_HD int64_t place(int64_t k) const {
    return front == nullptr || k < static_cast<int64_t>(*front) ? k : size - 1 - (k - static_cast<int64_t>(*front));
  }
};

}  // namespace pgccd
