// Feature pairs handed from the traversal to the narrow phase.
#pragma once

#include <cstdint>

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

}  // namespace pgccd
