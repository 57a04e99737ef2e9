// The bounding volume test tree (BVTT) of a body pair: splitting a node pair.
#pragma once

#include "kernels/traverse/overlap_item.h"
#include "kernels/traverse/pair_sweep.h"

namespace pgccd {

struct NodePair {
  int32_t first, second;
};

// Children `block * 8 + slot` of one node of a pair, each paired with the other node.
struct SplitPair {
  int32_t block;
  int32_t other;
  bool first_is_split;

  PGCCD_HD NodePair child(int slot) const {
    const int32_t node = block * kBlockWidth + slot;
    return first_is_split ? NodePair{node, other} : NodePair{other, node};
  }
};

// The test of a body against itself starts from the pairs of nodes that share a block, in all of its blocks, and the
// pairs of a leaf and itself: below these, every two leaves are paired once, not twice as mirror images. They are many
// and small, so the work is distributed from the start.
constexpr int kPairsInBlock = kBlockWidth * (kBlockWidth - 1) / 2;
PGCCD_HD SplitPair with_siblings(int32_t block, int slot) { return {block, block * kBlockWidth + slot, false}; }

// Decision by the clearance of two nodes; keeps them for NaN.
PGCCD_HD bool may_meet(float clearance) { return !(clearance > 0.0f); }

// Poses at all segment boundaries of a pair are kept by the caller: segment_count + 1 of them.
template <class Bodies>
class PairTree {
 public:
  using Sweep = typename SweepOf<Bodies>::type;

  PGCCD_HD PairTree(const Bodies& bodies, const Sweep& sweep, const LocalPose* poses)
      : bodies_(bodies), sweep_(sweep), poses_(poses) {}

  PGCCD_HD const Bodies& bodies() const { return bodies_; }
  PGCCD_HD const Sweep& sweep() const { return sweep_; }
  PGCCD_HD const LocalPose& pose(int k) const { return poses_[k]; }

  PGCCD_HD NodeLink link(int side, int32_t node) const {
    return bodies_.meshes.node_links[sweep_.first_block[side] * kBlockWidth + node];
  }
  // Number of node blocks of the first body's hierarchy.
  PGCCD_HD int32_t block_count() const {
    const MeshOffsets* offsets = bodies_.meshes.offsets + bodies_.mesh_index[sweep_.body[0]];
    return static_cast<int32_t>(offsets[1].block - offsets[0].block);
  }
  PGCCD_HD bool is_leaf(int side, int32_t node) const { return link(side, node).triangle_count > 0; }
  // False for empty slots too: nothing is below them, whatever their bounds.
  PGCCD_HD bool has_children(int side, int32_t node) const { return link(side, node).triangle_count == 0; }
  PGCCD_HD bool is_leaf_pair(NodePair nodes) const {
    return !has_children(0, nodes.first) && !has_children(1, nodes.second);
  }

  // The larger sphere of an inner pair is split.
  PGCCD_HD SplitPair split(NodePair nodes) const {
    const bool split_first = !has_children(1, nodes.second) ||
                             (has_children(0, nodes.first) && radius(0, nodes.first) >= radius(1, nodes.second));
    const int32_t block = split_first ? link(0, nodes.first).first : link(1, nodes.second).first;
    return {block, split_first ? nodes.second : nodes.first, split_first};
  }

  // Bit s is set if child s and the other node may meet during the step.
  PGCCD_HD uint32_t children_meeting(const SplitPair& split) const {
    uint32_t mask = 0;
    for (int k = 1; k <= sweep_.segment_count; ++k) {
      float clearance[kBlockWidth];
      clearances(split, k, clearance);
      for (int slot = 0; slot < kBlockWidth; ++slot) mask |= may_meet(clearance[slot]) ? 1u << slot : 0u;
    }
    return mask;
  }

  // The child that overlaps the other node most, or -1 if none does.
  PGCCD_HD int deepest_child(const SplitPair& split) const {
    int deepest = -1;
    float least = 0.0f;
    for (int k = 1; k <= sweep_.segment_count; ++k) {
      float clearance[kBlockWidth];
      clearances(split, k, clearance);
      for (int slot = 0; slot < kBlockWidth; ++slot) {
        if (!(clearance[slot] <= least) || (deepest >= 0 && clearance[slot] == least)) continue;
        least = clearance[slot];
        deepest = slot;
      }
    }
    return deepest;
  }

  // The node that is not split, over segment k.
  struct OtherNode {
    MovingPoints<1, float> centre;
    TurningSlab slab;
    float radius;
  };
  PGCCD_HD OtherNode other_node(const SplitPair& split, int k) const {
    const int side = split.first_is_split ? 1 : 0;
    const NodeBlock& b = sweep_.block(bodies_, side, split.other / kBlockWidth);
    const int slot = split.other % kBlockWidth;
    return {moving_centre(side, split.other, k), turning_slab(side, b, slot, k), local_radius(side, split.other)};
  }

  // Positive if a child and the other node certainly stay apart over segment k: squared distance of the spheres minus
  // their squared reach, at the time of the smallest distance, or the slab of one excludes the other's sphere. Positive
  // for an empty slot, the only one with a NaN radius.
  PGCCD_HD float clearance(const SplitPair& split, const OtherNode& other, int k, int slot) const {
    const int side = split.first_is_split ? 0 : 1;
    const NodeBlock& b = sweep_.block(bodies_, side, split.block);
    const float radius = sweep_.local_scale * b.radius[slot];
    const auto centre_at = [&](int end) {
      return Sweep::place(poses_[k - 1 + end], side, sweep_.node_centre(bodies_, side, split.block, slot, end));
    };
    const Vec3<float> start = centre_at(0) - other.centre.start[0], end = centre_at(1) - other.centre.end[0];
    const bool apart = slab_separates(other.slab, start, end, radius + sweep_.inflation) |
                       slab_separates(turning_slab(side, b, slot, k), -start, -end, other.radius + sweep_.inflation);
    const float reach = (radius + other.radius) + sweep_.inflation;
    return apart | (b.radius[slot] != b.radius[slot]) ? 1.0f : norm_squared(nearest_offset(start, end)) - reach * reach;
  }

  // Centre over segment k, and local radius.
  PGCCD_HD MovingPoints<1, float> moving_centre(int side, int32_t node, int k) const {
    const int block = node / kBlockWidth, slot = node % kBlockWidth;
    return {{Sweep::place(poses_[k - 1], side, sweep_.node_centre(bodies_, side, block, slot, 0))},
            {Sweep::place(poses_[k], side, sweep_.node_centre(bodies_, side, block, slot, 1))}};
  }
  PGCCD_HD float local_radius(int side, int32_t node) const { return sweep_.local_scale * radius(side, node); }

 private:
  PGCCD_HD float radius(int side, int32_t node) const {
    return sweep_.block(bodies_, side, node / kBlockWidth).radius[node % kBlockWidth];
  }

  // Clearances of all children. A branch-free loop over plain arrays, vectorised to eight lanes.
  PGCCD_HD void clearances(const SplitPair& split, int k, float out[kBlockWidth]) const {
    const OtherNode other = other_node(split, k);
    for (int slot = 0; slot < kBlockWidth; ++slot) out[slot] = clearance(split, other, k, slot);
  }

  PGCCD_HD TurningSlab turning_slab(int side, const NodeBlock& b, int slot, int k) const {
    const Vec3<float> normal{b.normal_x[slot], b.normal_y[slot], b.normal_z[slot]};
    const float scale = sweep_.local_scale;
    return {sweep_.turned(poses_[k - 1], side, normal), sweep_.turned(poses_[k], side, normal), scale * b.low[slot],
            scale * b.high[slot], sweep_.tilt * (scale * b.radius[slot])};
  }

  const Bodies& bodies_;
  const Sweep& sweep_;
  const LocalPose* poses_;
};

}  // namespace pgccd
