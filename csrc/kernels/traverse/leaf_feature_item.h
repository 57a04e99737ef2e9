// Bounds of the order of contacts for pairs of leaves: what is searched first if one contact of many at the same time
// is wanted.
#pragma once

#include <limits>

#include "core/candidate.h"
#include "kernels/traverse/pair_item.h"

namespace pgccd {

// A lower bound of the first feature of all candidates of a pair of leaves. `pair`: (2) bodies.
template <class Bodies>
PGCCD_HD FirstFeature first_feature_of(const Bodies& bodies, const int64_t* pair, NodePair leaves) {
  const int sides = pair[0] == pair[1] ? 2 : 1;
  constexpr int32_t kNone = std::numeric_limits<int32_t>::max();
  int32_t first = kNone;
  for (int side = 0; side < sides; ++side) {
    const MeshOffsets& offsets = bodies.meshes.offsets[bodies.mesh_index[pair[side]]];
    const int32_t node = side == 0 ? leaves.first : leaves.second;
    const NodeLink leaf = bodies.meshes.node_links[kBlockWidth * offsets.block + node];
    const Triangle* const triangles = bodies.meshes.triangles + offsets.face + leaf.first;
    for (int k = 0; k < leaf.triangle_count; ++k) {
      for (int c = 0; c < 3; ++c) {
        if (triangles[k].represented >> c & 1) first = smaller(first, triangles[k].vertex[c]);
      }
    }
  }
  return first != kNone ? first_feature(FeatureKind::kVertexFace, first) : first_feature(FeatureKind::kFaceVertex, 0);
}

}  // namespace pgccd
