// A pair of leaves: from triangles to candidate feature pairs. Every feature is represented by one of its triangles
// (representative triangles, Curtis, Tamstorf & Manocha 2008), so that no feature pair is emitted twice.
#pragma once

#include "core/candidate.h"
#include "core/fixed_directions.h"
#include "kernels/traverse/pair_item.h"

namespace pgccd {

// A leaf's triangles over segment k, eight at a time (T = Float8) or one (T = float), in the local frame.
template <class T, class Bodies>
PGCCD_HD MovingPoints<3, T> moving_triangles(const PairTree<Bodies>& tree, int side, int32_t triangle, int k) {
  using Sweep = typename PairTree<Bodies>::Sweep;
  const Corners<T> start = tree.sweep().template corners<T>(tree.bodies(), side, triangle, 0);
  const Corners<T> end = tree.sweep().template corners<T>(tree.bodies(), side, triangle, 1);
  const Placement at_start = tree.pose(k - 1).of[side], at_end = tree.pose(k).of[side];
  MovingPoints<3, T> out;
  for (int c = 0; c < 3; ++c) {
    out.start[c] = Sweep::place(at_start, start.corner[c]);
    out.end[c] = Sweep::place(at_end, end.corner[c]);
  }
  return out;
}

// One of a leaf's triangles at t = 0, in the local frame.
template <class Bodies>
PGCCD_HD void triangle_at_start(const PairTree<Bodies>& tree, int side, int32_t triangle, Vec3<float> (&out)[3]) {
  using Sweep = typename PairTree<Bodies>::Sweep;
  const Corners<float> at_start = tree.sweep().template corners<float>(tree.bodies(), side, triangle, 0);
  const Placement placement = tree.pose(0).of[side];
  for (int c = 0; c < 3; ++c) out[c] = Sweep::place(placement, at_start.corner[c]);
}

// Bits of the feature pairs that two triangles represent: vertex c of i and the face of j (c), vertex c of j and the
// face of i (3 + c), edge c of i and edge d of j (6 + 3 c + d).
constexpr int kFirstEdgeBit = 6;
constexpr int kFeaturePairBits = 15;

// A vertex and a face that is a segment or a point need a test only if the vertex is that of a point: other vertices
// are ends of an edge, which is tested against the segment, or, if the face is a point, belong to elements that are.
// Two points are tested once.
PGCCD_HD uint32_t represented_pairs(const Triangle& ti, const Triangle& tj) {
  const ElementKind kind_i = ti.kind(), kind_j = tj.kind();
  const bool is_point_i = kind_i == ElementKind::kPoint, is_point_j = kind_j == ElementKind::kPoint;
  uint32_t bits = 0;
  if (kind_j == ElementKind::kTriangle || is_point_i) bits |= static_cast<uint32_t>(ti.represented & 7);
  if (kind_i == ElementKind::kTriangle || (is_point_j && !is_point_i)) {
    bits |= static_cast<uint32_t>(tj.represented & 7) << 3;
  }
  const uint32_t edges_j = static_cast<uint32_t>(tj.represented >> 3) & 7u;
  for (int c = 0; c < 3; ++c) {
    if (ti.represented & (8 << c)) bits |= edges_j << (6 + 3 * c);
  }
  return bits;
}

// Feature pairs, of all 15, without a common vertex, for two triangles of one body: only these are tested.
PGCCD_HD uint32_t pairs_without_common_vertex(const Triangle& ti, const Triangle& tj) {
  uint32_t common = 0;  // bit 3 c + d: corner c of i is corner d of j
  for (int c = 0; c < 3; ++c) {
    for (int d = 0; d < 3; ++d) common |= ti.vertex[c] == tj.vertex[d] ? 1u << (3 * c + d) : 0u;
  }
  if (common == 0) return (1u << kFeaturePairBits) - 1u;
  const uint32_t corners_i = ((common & 7u) ? 1u : 0u) | ((common & 0x38u) ? 2u : 0u) | ((common & 0x1c0u) ? 4u : 0u);
  const uint32_t corners_j = (common | common >> 3 | common >> 6) & 7u;
  // Edge c of i joins its corners c and c + 1, edge d of j likewise: adjacent rows or columns.
  const uint32_t with_next_d = common | (common >> 1 & 0xdbu) | (common & 0x49u) << 2;
  const uint32_t edges = with_next_d | with_next_d >> 3 | (with_next_d & 7u) << 6;
  return ~(corners_i | corners_j << 3 | edges << kFirstEdgeBit) & ((1u << kFeaturePairBits) - 1u);
}

// Bits of the edges and faces that two triangles represent: edge c of i and the face of j (c), edge c of j and the face
// of i (3 + c). Of one body, only those without a common vertex.
constexpr int kCrossingBits = 6;

PGCCD_HD uint32_t represented_crossings(const Triangle& ti, const Triangle& tj, bool is_one_body) {
  uint32_t bits = 0;
  if (tj.kind() == ElementKind::kTriangle) bits |= static_cast<uint32_t>(ti.represented >> 3 & 7);
  if (ti.kind() == ElementKind::kTriangle) bits |= static_cast<uint32_t>(tj.represented >> 3 & 7) << 3;
  if (!is_one_body) return bits;
  uint32_t common_i = 0, common_j = 0;  // corners
  for (int c = 0; c < 3; ++c) {
    for (int d = 0; d < 3; ++d) {
      if (ti.vertex[c] != tj.vertex[d]) continue;
      common_i |= 1u << c;
      common_j |= 1u << d;
    }
  }
  // Edge c joins corners c and c + 1.
  const auto edges_at = [](uint32_t corners) { return (corners | corners >> 1 | corners << 2) & 7u; };
  return bits & ~(edges_at(common_i) | edges_at(common_j) << 3);
}

// Calls emit(kind, feature_i, feature_j) for the edge and face of that bit. Of one body, the edge comes before the
// face.
template <class Emit>
PGCCD_HD void emit_crossing(const Triangle& ti, const Triangle& tj, int bit, bool is_one_body, Emit&& emit) {
  if (bit < 3) return emit(FeatureKind::kEdgeFace, ti.edge[bit], tj.face);
  if (is_one_body) return emit(FeatureKind::kEdgeFace, tj.edge[bit - 3], ti.face);
  emit(FeatureKind::kFaceEdge, ti.face, tj.edge[bit - 3]);
}

// True where the edge and the face of that bit are certainly apart at t = 0. `corner(side, index)`: of both triangles.
template <class Corner, class Mask>
PGCCD_HD Mask crossing_apart(Corner&& corner, int bit, float distance, Mask out) {
  using Point = decltype(corner(0, 0));
  const int of_edge = bit < 3 ? 0 : 1, of_face = 1 - of_edge;
  const int c = bit < 3 ? bit : bit - 3, next = c == 2 ? 0 : c + 1;
  const Point edge[2] = {corner(of_edge, c), corner(of_edge, next)};
  const Point face[3] = {corner(of_face, 0), corner(of_face, 1), corner(of_face, 2)};
  return edge_and_face_apart(edge, face, distance, out);
}

// A feature pair at both ends of a segment; or lanes of them (T = Float8).
template <class T>
struct MovingFeatures {
  using Mask = decltype(T{} == T{});
  FeaturePair<T> start, end;
  Mask is_edge_edge;

  // Both are true only where the features stay apart; the second rejects more pairs, and is slower. `out` where the
  // answer is not needed.
  PGCCD_HD Mask plainly_apart(float distance, Mask out = {}) const {
    return stays_apart(start, end, distance, is_edge_edge, out);
  }
  PGCCD_HD Mask stepwise_apart(float distance, Mask out = {}) const {
    return stays_apart_stepwise(start, end, distance, is_edge_edge, out);
  }
};

// The feature pair of a bit. `corner(side, index, end)` returns a triangle's corner. Both kinds of pairs take one path
// through the code, because they share a warp on a device.
template <class Corner>
PGCCD_HD MovingFeatures<float> moving_features(Corner&& corner, int bit) {
  const bool is_edge_edge = bit >= kFirstEdgeBit, is_face_of_i = bit >= 3 && !is_edge_edge;
  const int first_side = is_face_of_i ? 1 : 0, second_side = 1 - first_side;
  // Corners x0 .. x3 of the feature pair: edge-edge c, c + 1; d, d + 1; vertex-face c; 0, 1, 2.
  const int c = is_edge_edge ? (bit - 6) / 3 : (is_face_of_i ? bit - 3 : bit);
  const int d = is_edge_edge ? (bit - 6) % 3 : 0;
  const int next_c = c == 2 ? 0 : c + 1, next_d = d == 2 ? 0 : d + 1;
  const auto features = [&](int end) -> FeaturePair<float> {
    const Vec3<float> from = corner(first_side, c, end), to = corner(second_side, d, end);
    const Vec3<float> a_tip = is_edge_edge ? corner(first_side, next_c, end) : corner(second_side, 1, end);
    const Vec3<float> b_tip = corner(second_side, is_edge_edge ? next_d : 2, end);
    return {to - from, a_tip - (is_edge_edge ? from : to), b_tip - to};
  };
  return {features(0), features(1), is_edge_edge};
}

// Calls emit(kind, feature_i, feature_j) for the feature pair of that bit. Of one body, the vertex comes before the
// face and the smaller edge before the other.
template <class Emit>
PGCCD_HD void emit_pair(const Triangle& ti, const Triangle& tj, int bit, bool is_one_body, Emit&& emit) {
  if (is_one_body) {
    if (bit >= 3 && bit < kFirstEdgeBit) return emit(FeatureKind::kVertexFace, tj.vertex[bit - 3], ti.face);
    if (bit >= kFirstEdgeBit) {
      const int32_t edge_i = ti.edge[(bit - 6) / 3], edge_j = tj.edge[(bit - 6) % 3];
      return emit(FeatureKind::kEdgeEdge, smaller(edge_i, edge_j), larger(edge_i, edge_j));
    }
  }
  if (bit < 3) return emit(FeatureKind::kVertexFace, ti.vertex[bit], tj.face);
  if (bit < 6) return emit(FeatureKind::kFaceVertex, ti.face, tj.vertex[bit - 3]);
  emit(FeatureKind::kEdgeEdge, ti.edge[(bit - 6) / 3], tj.edge[(bit - 6) % 3]);
}

}  // namespace pgccd
