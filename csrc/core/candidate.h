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
  kEdgeFace = 3,    // edge of i that passes through a face of j at t = 0
  kFaceEdge = 4,    // edge of j that passes through a face of i at t = 0
};
constexpr int32_t kFeatureKinds = 5;

struct Candidate {
  int32_t pair;  // index into the list of body pairs
  int32_t kind;  // FeatureKind
  int32_t feature_i;
  int32_t feature_j;
};

PGCCD_HD bool is_crossing(const Candidate& c) { return c.kind >= static_cast<int32_t>(FeatureKind::kEdgeFace); }

// Numbers of candidates at the front and at the back of a buffer.
struct CandidateCounts {
  Counter front, back;

  PGCCD_HD Counter sum() const { return front + back; }
};

// Candidates in memory: `size` of them, or, if the host has not read the device's counts, some at the front and some at
// the back of a buffer of `size`, without those that were there before.
struct CandidateSpan {
  const Candidate* items = nullptr;
  int64_t size = 0;
  const CandidateCounts* counts = nullptr;  // null: all `size` are valid
  const CandidateCounts* before = nullptr;

  // False on overflow, when front and back may overlap.
  PGCCD_HD bool fits_all() const { return counts == nullptr || fits(counts->sum(), size); }
  // Zero on overflow.
  PGCCD_HD int64_t count() const {
    if (counts == nullptr) return size;
    return fits_all() ? static_cast<int64_t>(counts->sum() - before->sum()) : 0;
  }
  // Index of the k-th of `count()`.
  PGCCD_HD int64_t place(int64_t k) const {
    if (counts == nullptr) return k;
    const int64_t front = static_cast<int64_t>(counts->front - before->front);
    if (k < front) return static_cast<int64_t>(before->front) + k;
    return size - 1 - (static_cast<int64_t>(before->back) + k - front);
  }
};

}  // namespace pgccd
