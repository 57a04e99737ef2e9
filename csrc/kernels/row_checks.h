// Validation of rows that index other rows, before they are used.
#pragma once

#include "core/bodies.h"
#include "core/candidate.h"

namespace pgccd {

struct NamedPairs {
  const int64_t* pairs;  // (count, 2) bodies
  int64_t count;
};

// True if a candidate has a valid pair, kind, and features of the pair's bodies.
template <class Bodies>
PGCCD_HD bool names_features(const Bodies& bodies, const NamedPairs& pairs, const Candidate& candidate) {
  if (!is_within(candidate.pair, pairs.count)) return false;
  const auto kind = static_cast<FeatureKind>(candidate.kind);
  if (candidate.kind < 0 || candidate.kind >= kFeatureKinds) return false;
  for (int side = 0; side < 2; ++side) {
    const int64_t body = pairs.pairs[2 * int64_t{candidate.pair} + side];
    if (!is_sound(bodies, body)) return false;
    const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body];
    const bool is_vertex = kind == (side == 0 ? FeatureKind::kVertexFace : FeatureKind::kFaceVertex);
    const bool is_edge =
        kind == FeatureKind::kEdgeEdge || kind == (side == 0 ? FeatureKind::kEdgeFace : FeatureKind::kFaceEdge);
    const int64_t edges_or_faces = is_edge ? rows[1].edge - rows[0].edge : rows[1].face - rows[0].face;
    const int64_t count = is_vertex ? rows[1].vertex - rows[0].vertex : edges_or_faces;
    if (!is_within(side == 0 ? candidate.feature_i : candidate.feature_j, count)) return false;
  }
  return true;
}

}  // namespace pgccd
