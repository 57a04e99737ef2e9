// One step of the bounding volume test tree (BVTT) of a body pair: split a node pair, or turn a leaf pair into
// candidates.
#pragma once

#include "core/candidate.h"
#include "kernels/traverse/overlap_item.h"

namespace pgccd {

struct NodePair {
  int32_t first, second;
};

// Poses at all segment boundaries of a pair are kept by the caller: segment_count + 1 of them.
template <class Bodies>
class PairTree {
 public:
  using Sweep = typename SweepOf<Bodies>::type;

  PGCCD_HD PairTree(const Bodies& bodies, const Sweep& sweep, const LocalPose* poses)
      : bodies_(bodies), sweep_(sweep), poses_(poses) {}

  PGCCD_HD bool nodes_meet(NodePair nodes) const {
    const float reach = (sweep_.local_radius(sweep_.sphere(bodies_, 0, nodes.first)) +
                         sweep_.local_radius(sweep_.sphere(bodies_, 1, nodes.second))) +
                        sweep_.inflation;
    Vec3<float> start = node_offset(nodes, 0);
    for (int k = 1; k <= sweep_.segment_count; ++k) {
      const Vec3<float> end = node_offset(nodes, k);
      if (spheres_meet(start, end, reach)) return true;
      start = end;
    }
    return false;
  }

  PGCCD_HD NodeLink link(int side, int32_t node) const {
    return bodies_.meshes.node_links[bodies_.meshes.offsets[sweep_.mesh[side]].node + node];
  }

  // Children of an inner pair: the larger sphere is split. False for a pair of leaves.
  PGCCD_HD bool split(NodePair nodes, NodePair children[2]) const {
    const NodeLink first = link(0, nodes.first), second = link(1, nodes.second);
    const bool first_is_leaf = first.triangle_count > 0, second_is_leaf = second.triangle_count > 0;
    if (first_is_leaf && second_is_leaf) return false;
    const bool split_first = second_is_leaf || (!first_is_leaf && sweep_.sphere(bodies_, 0, nodes.first).radius >=
                                                                      sweep_.sphere(bodies_, 1, nodes.second).radius);
    for (int child = 0; child < 2; ++child) {
      children[child] =
          split_first ? NodePair{first.first + child, nodes.second} : NodePair{nodes.first, second.first + child};
    }
    return true;
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
  PGCCD_HD Vec3<float> node_offset(NodePair nodes, int k) const {
    return sweep_.centre(bodies_, poses_[k], k, 1, nodes.second) - sweep_.centre(bodies_, poses_[k], k, 0, nodes.first);
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
