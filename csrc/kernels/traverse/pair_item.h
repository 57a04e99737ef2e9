// One step of the bounding volume test tree (BVTT) of a body pair: split a node pair, or turn a leaf pair into candidates.
#pragma once

#include "core/candidate.h"
#include "kernels/traverse/overlap_item.h"

namespace pgccd {

struct NodePair {
  int32_t first, second;
};

// Nodes `block * 8 + slot` for the set bits of `mask`, each paired with `other`.
struct SplitPair {
  int32_t block;
  int32_t other;
  bool first_is_split;
  uint32_t mask;

  PGCCD_HD NodePair child(int slot) const {
    const int32_t node = block * kBlockWidth + slot;
    return first_is_split ? NodePair{node, other} : NodePair{other, node};
  }
};

// Poses at all segment boundaries of a pair are kept by the caller: segment_count + 1 of them.
template <class Bodies>
class PairTree {
 public:
  using Sweep = typename SweepOf<Bodies>::type;

  PGCCD_HD PairTree(const Bodies& bodies, const Sweep& sweep, const LocalPose* poses)
      : bodies_(bodies), sweep_(sweep), poses_(poses) {}

  PGCCD_HD bool is_leaf(int side, int32_t node) const { return link(side, node).triangle_count > 0; }
  PGCCD_HD bool is_leaf_pair(NodePair nodes) const { return is_leaf(0, nodes.first) && is_leaf(1, nodes.second); }

  // The larger sphere of an inner pair is split; the mask tells which of its children meet the other node during the step.
  PGCCD_HD SplitPair split(NodePair nodes) const {
    const bool split_first =
        is_leaf(1, nodes.second) || (!is_leaf(0, nodes.first) && radius(0, nodes.first) >= radius(1, nodes.second));
    const int side = split_first ? 0 : 1;
    const int32_t parent = split_first ? nodes.first : nodes.second;
    SplitPair out{link(side, parent).first, split_first ? nodes.second : nodes.first, split_first, 0};
    for (int k = 1; k <= sweep_.segment_count; ++k) out.mask |= children_meet(side, out.block, out.other, k);
    return out;
  }

  // Calls emit(kind, feature_i, feature_j) for every feature pair that the triangles of two leaves stand for.
  template <class Emit>
  PGCCD_HD void leaf_candidates(NodePair leaves, Emit&& emit) const {
    const NodeLink first = link(0, leaves.first), second = link(1, leaves.second);
    for (int p = 0; p < first.triangle_count; ++p) {
      const Triangle& ti = triangle(0, first.first + p);
      for (int q = 0; q < second.triangle_count; ++q) {
        const Triangle& tj = triangle(1, second.first + q);
        if ((ti.represented | tj.represented) != 0 && triangles_meet(ti, tj)) emit_features(ti, tj, emit);
      }
    }
  }

 private:
  PGCCD_HD NodeLink link(int side, int32_t node) const {
    return bodies_.meshes.node_links[bodies_.meshes.offsets[sweep_.mesh[side]].block * kBlockWidth + node];
  }
  PGCCD_HD float radius(int side, int32_t node) const {
    return sweep_.block(bodies_, side, node / kBlockWidth, 0).radius[node % kBlockWidth];
  }
  PGCCD_HD Vec3<float> centre(int side, int32_t node, int k, int end) const {
    const NodeBlock& b = sweep_.block(bodies_, side, node / kBlockWidth, end);
    const int slot = node % kBlockWidth;
    return Sweep::place(poses_[k], side, {b.x[slot], b.y[slot], b.z[slot]});
  }

  // Over the segment that ends at boundary k.
  PGCCD_HD uint32_t children_meet(int side, int32_t block, int32_t other, int k) const {
    const Vec3<float> other_start = centre(1 - side, other, k - 1, 0);
    const Vec3<float> other_end = centre(1 - side, other, k, 1);
    const float scale = sweep_.node_scale();
    const float other_reach = scale * radius(1 - side, other) + sweep_.inflation;
    const NodeBlock& start = sweep_.block(bodies_, side, block, 0);
    const NodeBlock& end = sweep_.block(bodies_, side, block, 1);
    const LocalPose pose_start = poses_[k - 1], pose_end = poses_[k];
    uint32_t meets[kBlockWidth];
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const Vec3<float> from = Sweep::place(pose_start, side, {start.x[slot], start.y[slot], start.z[slot]}) - other_start;
      const Vec3<float> to = Sweep::place(pose_end, side, {end.x[slot], end.y[slot], end.z[slot]}) - other_end;
      meets[slot] = spheres_meet(from, to, scale * start.radius[slot] + other_reach) ? 1u << slot : 0u;
    }
    uint32_t mask = 0;
    for (int slot = 0; slot < kBlockWidth; ++slot) mask |= meets[slot];
    return mask;
  }

  PGCCD_HD const Triangle& triangle(int side, int32_t row) const {
    return bodies_.meshes.triangles[bodies_.meshes.offsets[sweep_.mesh[side]].face + row];
  }

  PGCCD_HD bool triangles_meet(const Triangle& ti, const Triangle& tj) const {
    MovingTriangle i, j;
    for (int corner = 0; corner < 3; ++corner) {
      i.start[corner] = sweep_.vertex(bodies_, poses_[0], 0, 0, ti.vertex[corner]);
      j.start[corner] = sweep_.vertex(bodies_, poses_[0], 0, 1, tj.vertex[corner]);
    }
    for (int k = 1; k <= sweep_.segment_count; ++k) {
      for (int corner = 0; corner < 3; ++corner) {
        i.end[corner] = sweep_.vertex(bodies_, poses_[k], k, 0, ti.vertex[corner]);
        j.end[corner] = sweep_.vertex(bodies_, poses_[k], k, 1, tj.vertex[corner]);
      }
      if (triangles_may_meet(i, j, sweep_.inflation)) return true;
      for (int corner = 0; corner < 3; ++corner) {
        i.start[corner] = i.end[corner];
        j.start[corner] = j.end[corner];
      }
    }
    return false;
  }

  template <class Emit>
  PGCCD_HD static void emit_features(const Triangle& ti, const Triangle& tj, Emit& emit) {
    for (int corner = 0; corner < 3; ++corner) {
      if (ti.represented & (1 << corner)) emit(FeatureKind::kVertexFace, ti.vertex[corner], tj.face);
      if (tj.represented & (1 << corner)) emit(FeatureKind::kFaceVertex, ti.face, tj.vertex[corner]);
      if (!(ti.represented & (8 << corner))) continue;
      for (int other = 0; other < 3; ++other) {
        if (tj.represented & (8 << other)) emit(FeatureKind::kEdgeEdge, ti.edge[corner], tj.edge[other]);
      }
    }
  }

  const Bodies& bodies_;
  const Sweep& sweep_;
  const LocalPose* poses_;
};

}  // namespace pgccd
