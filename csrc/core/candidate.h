// Feature pairs passed from the traversal to the narrow phase.
#pragma once

#include <cstdint>
#include <limits>
#include <type_traits>

#include "core/counter.h"

namespace pgccd {

// Kinds for a body pair (i, j), i < j. The numeric order is the canonical order of contacts with equal toi.
enum class FeatureKind : int32_t {
  kVertexFace = 0,  // vertex of i, face of j
  kFaceVertex = 1,  // vertex of j, face of i
  kEdgeEdge = 2,    // edge of i, edge of j
  kEdgeFace = 3,    // edge of i that passes through a face of j at t = 0
  kFaceEdge = 4,    // edge of j that passes through a face of i at t = 0
  kInside = 5,      // vertex of i inside of j, a solid, at t = 0; feature_j is 0
  kContains = 6,    // vertex of j inside of i; feature_i is 0
};
constexpr int32_t kFeatureKinds = 7;

template <FeatureKind kKind>
using KindConstant = std::integral_constant<FeatureKind, kKind>;

struct Candidate {
  int32_t pair;  // index into the list of body pairs
  int32_t kind;  // FeatureKind
  int32_t feature_i;
  int32_t feature_j;
};

// Whether the features are two edges, not a vertex and a face. Asked wherever these kinds differ, so that another kind
// fails to compile there until it has a case.
template <FeatureKind kKind>
  requires(kKind == FeatureKind::kVertexFace || kKind == FeatureKind::kEdgeEdge)
constexpr bool kIsEdgeEdge = kKind == FeatureKind::kEdgeEdge;

PGCCD_HD bool is_crossing(const Candidate& c) {
  return c.kind == static_cast<int32_t>(FeatureKind::kEdgeFace) ||
         c.kind == static_cast<int32_t>(FeatureKind::kFaceEdge);
}
PGCCD_HD bool is_enclosure(const Candidate& c) { return c.kind >= static_cast<int32_t>(FeatureKind::kInside); }
// Decided by the bodies at t = 0 alone.
PGCCD_HD bool is_of_start(const Candidate& c) { return c.kind >= static_cast<int32_t>(FeatureKind::kEdgeFace); }

// Calls use(kind) with the kind, as a constant, of a candidate that is searched over time. A face and a vertex are a
// vertex and a face of the bodies in reverse order.
template <class Use>
PGCCD_HD auto with_kind(const Candidate& c, const Use& use) {
  if (c.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge)) return use(KindConstant<FeatureKind::kEdgeEdge>{});
  return use(KindConstant<FeatureKind::kVertexFace>{});
}

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

// A kind and the feature of the first body, in the order of contacts.
using FirstFeature = int64_t;
constexpr FirstFeature kNoFeature = std::numeric_limits<FirstFeature>::max();
PGCCD_HD FirstFeature first_feature(FeatureKind kind, int32_t feature_i) {
  return static_cast<int64_t>(kind) << 32 | feature_i;
}

// What a search of a first part of the candidates found, of each pair (device, pair_count).
struct FirstPart {
  const unsigned long long* toi;  // bits of the earliest, all ones for none
  bool any_will_do;               // whether pairs with a contact are decided
  const FirstFeature* known;      // of contacts at t = 0, else kNoFeature; null: pairs with such a contact are decided
};

}  // namespace pgccd
