// Feature pairs handed from the traversal to the narrow phase.
#pragma once

#include <cstdint>

#include "core/counter.h"

namespace pgccd {

// Of a body pair (i, j), i < j. The numeric order is the canonical order of contacts with equal toi.
enum class FeatureKind : int32_t {
  kVertexFace = 0,  // vertex of i, face of j
  kFaceVertex = 1,  // vertex of j, face of i
  kEdgeEdge = 2,    // edge of i, edge of j
};

struct Candidate {
  int32_t pair;  // row in the list of body pairs
  int32_t kind;  // FeatureKind
  int32_t feature_i;
  int32_t feature_j;
};

// Candidates in memory: `size` of them, or, where the host has not read the device's counts, some from the
// front and some from the back of a buffer of `size`.
struct CandidateSpan {
  const Candidate* items = nullptr;
  int64_t size = 0;
  const Counter* front = nullptr;  // null: all are given
  const Counter* back = nullptr;

  // Zero on overflow: rows there may mix two candidates.
  PGCCD_HD int64_t count() const {
    if (front == nullptr) return size;
    const Counter counted = *front + *back;
    return fits(counted, size) ? static_cast<int64_t>(counted) : 0;
  }
  // Where the k-th of `count()` is.
  PGCCD_HD int64_t place(int64_t k) const {
    return front == nullptr || k < static_cast<int64_t>(*front) ? k : size - 1 - (k - static_cast<int64_t>(*front));
  }
};

}  // namespace pgccd
