// A pair of leaves: from triangles to candidate feature pairs. Every feature is spoken for by one of its triangles
// (representative triangles, Curtis, Tamstorf & Manocha 2008), so that no feature pair is emitted twice.
#pragma once

#include "core/candidate.h"
#include "kernels/traverse/pair_item.h"

namespace pgccd {

// A leaf's triangles over segment k, eight at a time (T = Float8) or one (T = float), in the local frame.
template <class T, class Bodies>
PGCCD_HD MovingPoints<3, T> moving_triangles(const PairTree<Bodies>& tree, int side, int32_t triangle, int k) {
  using Sweep = typename PairTree<Bodies>::Sweep;
  const Corners<T> start = tree.sweep().template corners<T>(tree.bodies(), side, triangle, 0);
  const Corners<T> end = tree.sweep().template corners<T>(tree.bodies(), side, triangle, 1);
  MovingPoints<3, T> out;
  for (int c = 0; c < 3; ++c) {
    out.start[c] = Sweep::place(tree.pose(k - 1), side, start.corner[c]);
    out.end[c] = Sweep::place(tree.pose(k), side, end.corner[c]);
  }
  return out;
}

namespace leaf_detail {

PGCCD_HD MovingPoints<1, float> corner(const MovingPoints<3, float>& t, int c) { return {{t.start[c]}, {t.end[c]}}; }
PGCCD_HD MovingPoints<2, float> side(const MovingPoints<3, float>& t, int c) {
  const int d = c == 2 ? 0 : c + 1;
  return {{t.start[c], t.start[d]}, {t.end[c], t.end[d]}};
}

}  // namespace leaf_detail

// Bits of the feature pairs that two triangles stand for: vertex c of i and the face of j (c), vertex c of j and the
// face of i (3 + c), edge c of i and edge d of j (6 + 3 c + d).
PGCCD_HD uint32_t represented_pairs(const Triangle& ti, const Triangle& tj) {
  uint32_t bits = static_cast<uint32_t>((ti.represented & 7) | ((tj.represented & 7) << 3));
  const uint32_t edges_j = static_cast<uint32_t>(tj.represented >> 3) & 7u;
  for (int c = 0; c < 3; ++c) {
    if (ti.represented & (8 << c)) bits |= edges_j << (6 + 3 * c);
  }
  return bits;
}

// May the feature pair of that bit meet over the segment?
PGCCD_HD bool pair_meets(const MovingPoints<3, float>& i, const MovingPoints<3, float>& j, int bit, float distance) {
  using namespace leaf_detail;
  if (bit < 3) return !stay_apart(corner(i, bit), j, distance);
  if (bit < 6) return !stay_apart(corner(j, bit - 3), i, distance);
  return !stay_apart(side(i, (bit - 6) / 3), side(j, (bit - 6) % 3), distance);
}

constexpr int kFeaturePairBits = 15;

// Calls emit(kind, feature_i, feature_j) for the feature pair of that bit.
template <class Emit>
PGCCD_HD void emit_pair(const Triangle& ti, const Triangle& tj, int bit, Emit&& emit) {
  if (bit < 3) return emit(FeatureKind::kVertexFace, ti.vertex[bit], tj.face);
  if (bit < 6) return emit(FeatureKind::kFaceVertex, ti.face, tj.vertex[bit - 3]);
  emit(FeatureKind::kEdgeEdge, ti.edge[(bit - 6) / 3], tj.edge[(bit - 6) % 3]);
}

}  // namespace pgccd
