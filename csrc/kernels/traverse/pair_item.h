// The bounding volume test tree (BVTT) of a body pair: splitting a node pair.
#pragma once

#include <type_traits>

#include "kernels/traverse/deforming_sweep.h"
#include "kernels/traverse/overlap_item.h"
#include "kernels/traverse/rigid_sweep.h"

namespace pgccd {

// The local frame of a body pair.
template <class Bodies>
using SweepOf = std::conditional_t<std::is_same_v<Bodies, RigidBodies>, RigidSweep, DeformingSweep>;

struct NodePair {
  int32_t first, second;
};

// A pair of leaves of one row of the body pairs, passed from the descent to the search of their triangles.
struct alignas(16) LeafPair {
  int32_t pair;
  NodePair leaves;
  float begin;  // the leaves certainly stay apart before it
};

// Place of a node; unsigned division takes fewer instructions.
PGCCD_HD int32_t block_of(int32_t node) { return static_cast<int32_t>(static_cast<uint32_t>(node) / kBlockWidth); }
PGCCD_HD int slot_of(int32_t node) { return static_cast<int>(static_cast<uint32_t>(node) % kBlockWidth); }

// A node pair of which one node is split: the children in one block of that side, each paired with the other node.
class alignas(8) SplitPair {
 public:
  SplitPair() = default;
  PGCCD_HD static SplitPair none() { return {0, -1, 0}; }
  PGCCD_HD SplitPair(int side, int32_t block, int32_t other) : block_and_side_(2 * block + side), other_(other) {}

  PGCCD_HD bool is_none() const { return block_and_side_ < 0; }
  PGCCD_HD int side() const { return block_and_side_ & 1; }
  PGCCD_HD int32_t block() const { return block_and_side_ >> 1; }
  PGCCD_HD int32_t node(int slot) const { return block() * kBlockWidth + slot; }
  PGCCD_HD int32_t other() const { return other_; }
  PGCCD_HD NodePair child(int slot) const {
    return side() == 0 ? NodePair{node(slot), other_} : NodePair{other_, node(slot)};
  }

 private:
  int32_t block_and_side_;  // nodes have 31-bit numbers, blocks 28 bits
  int32_t other_;
};

// The test of a body against itself starts from the pairs of nodes that share a block, in all of its blocks, and the
// pairs of a leaf and itself: below these, every two leaves are paired once, not twice as mirror images. They are many
// and small, so the work is distributed from the start.
constexpr int kPairsInBlock = kBlockWidth * (kBlockWidth - 1) / 2;
PGCCD_HD SplitPair with_siblings(int32_t block, int slot) { return {1, block, block * kBlockWidth + slot}; }

// Decision by the clearance of two nodes; keeps them for NaN.
PGCCD_HD bool may_meet(float clearance) { return !(clearance > 0.0f); }

// Poses at all segment boundaries of a pair are kept by the caller: segment_count + 1 of them.
template <class Bodies>
class PairTree {
 public:
  using Sweep = SweepOf<Bodies>;

  PGCCD_HD PairTree(const Bodies& bodies, const Sweep& sweep, const LocalPose* poses)
      : bodies_(bodies), sweep_(sweep), poses_(poses) {}

  PGCCD_HD const Bodies& bodies() const { return bodies_; }
  PGCCD_HD const Sweep& sweep() const { return sweep_; }
  PGCCD_HD const LocalPose& pose(int k) const { return poses_[k]; }

  PGCCD_HD NodeLink link(int side, int32_t node) const { return sweep_.links[side][node]; }
  PGCCD_HD const NodeSupport& support(int side, int32_t node) const {
    return bodies_.meshes.node_supports[(sweep_.links[side] - bodies_.meshes.node_links) + node];
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
  PGCCD_HD SplitPair split(NodePair nodes) const { return split(nodes, link(0, nodes.first), link(1, nodes.second)); }
  // With the nodes' links.
  PGCCD_HD SplitPair split(NodePair nodes, NodeLink first, NodeLink second) const {
    const bool split_first =
        second.triangle_count != 0 || (first.triangle_count == 0 && radius(0, nodes.first) >= radius(1, nodes.second));
    return split_first ? SplitPair{0, first.first, nodes.second} : SplitPair{1, second.first, nodes.first};
  }

  // A node over segment k.
  struct MovingNode {
    MovingPoints<1, float> centre;
    MovingSlab slab;
    float radius;
  };
  // The node that is not split.
  PGCCD_HD MovingNode other_node(const SplitPair& split, int k) const {
    return node_over(1 - split.side(), block_of(split.other()), slot_of(split.other()), k);
  }

  // Positive if a child and the other node certainly stay apart over segment k: squared distance of the spheres minus
  // their squared reach, at the time of the smallest distance, or the slab of one excludes the other's sphere. Positive
  // for an empty slot, the only one with a NaN radius.
  PGCCD_HD float clearance(const SplitPair& split, const MovingNode& other, int k, int slot) const {
    const MovingNode child = node_over(split.side(), split.block(), slot, k);
    const Vec3<float> start = child.centre.start[0] - other.centre.start[0];
    const Vec3<float> end = child.centre.end[0] - other.centre.end[0];
    const bool apart = slab_separates(other.slab, start, end, child.radius + sweep_.inflation) |
                       slab_separates(child.slab, -start, -end, other.radius + sweep_.inflation);
    const float reach = (child.radius + other.radius) + sweep_.inflation;
    return apart | (child.radius != child.radius) ? 1.0f : norm_squared(nearest_offset(start, end)) - reach * reach;
  }

  // Centre over segment k, and local radius.
  PGCCD_HD MovingPoints<1, float> moving_centre(int side, int32_t node, int k) const {
    const Placement at_start = poses_[k - 1].of[side], at_end = poses_[k].of[side];
    return moving_centre(side, block_of(node), slot_of(node), at_start, at_end);
  }
  PGCCD_HD Vec3<float> centre_at_start(int side, int32_t node) const {
    return Sweep::place(poses_[0].of[side], sweep_.node_centre(side, block_of(node), slot_of(node), 0));
  }
  PGCCD_HD float local_radius(int side, int32_t node) const { return sweep_.local_scale * radius(side, node); }

 private:
  PGCCD_HD float radius(int side, int32_t node) const {
    return sweep_.blocks[side][block_of(node)].radius[slot_of(node)];
  }

  PGCCD_HD MovingPoints<1, float> moving_centre(int side, int32_t block, int slot, const Placement& at_start,
                                                const Placement& at_end) const {
    return {{Sweep::place(at_start, sweep_.node_centre(side, block, slot, 0))},
            {Sweep::place(at_end, sweep_.node_centre(side, block, slot, 1))}};
  }

  PGCCD_HD MovingNode node_over(int side, int32_t block, int slot, int k) const {
    const NodeBlock& b = sweep_.blocks[side][block];
    const Placement at_start = poses_[k - 1].of[side], at_end = poses_[k].of[side];
    const Vec3<float> normal{b.normal_x[slot], b.normal_y[slot], b.normal_z[slot]};
    const float scale = sweep_.local_scale, radius = scale * b.radius[slot];
    const float grown = sweep_.slab_growth(side) * radius;
    return {
        moving_centre(side, block, slot, at_start, at_end),
        {sweep_.mean_of_turned(at_start, at_end, normal), scale * b.low[slot] - grown, scale * b.high[slot] + grown},
        radius};
  }

  const Bodies& bodies_;
  const Sweep& sweep_;
  const LocalPose* poses_;
};

}  // namespace pgccd
