// Linear bounding volume hierarchy over bodies in Morton order (Lauterbach et al. 2009; the radix tree of Karras 2012,
// built bottom-up as in Apetrei 2014): keys, nodes, the construction, and one body's traversal.
//
// A pair is reported by its smaller body, with sizes rounded to octaves, and within an octave by the first one. So a
// body as large as the scene does not traverse the whole tree: each of the others finds it.
#pragma once

#include "core/bits.h"
#include "kernels/broad/filter_box.h"
#include "kernels/broad/scene_sample.h"

namespace pgccd {

// Positions are mapped into (-1, 1), so that a few distant bodies do not use up the digits of the others.
struct LbvhFrame {
  double origin[3];
  double spread;
};

PGCCD_HD LbvhFrame lbvh_frame(const double (&mean)[3], const double (&mean_deviation)[3]) {
  LbvhFrame frame{{}, 0.0};
  for (int k = 0; k < 3; ++k) {
    if (std::fabs(mean[k]) < 0x1p1000) frame.origin[k] = mean[k];
    frame.spread = larger(frame.spread, 4.0 * mean_deviation[k]);
  }
  if (!(frame.spread > 0x1p-1000 && frame.spread < 0x1p1000)) frame.spread = 1.0;
  return frame;
}

// Called by all threads that share the sample.
template <class Sample>
PGCCD_TARGET LbvhFrame choose_lbvh_frame(Sample&& sample, const BroadBodies& bodies) {
  const double weight = sample_weight(bodies.count);
  double mean[3] = {}, deviation[3] = {};
  sample.for_each(bodies, [&](const SweptBox& box) {
    for (int k = 0; k < 3; ++k) mean[k] += weight * component(middle_of(box), k);
  });
  sample.sum(mean);
  sample.for_each(bodies, [&](const SweptBox& box) {
    for (int k = 0; k < 3; ++k) deviation[k] += weight * std::fabs(component(middle_of(box), k) - mean[k]);
  });
  sample.sum(deviation);
  return lbvh_frame(mean, deviation);
}

PGCCD_HD uint64_t spread_bits(uint64_t x) {  // two zero bits after each of 21
  x = (x | (x << 32)) & 0x001f00000000ffffull;
  x = (x | (x << 16)) & 0x001f0000ff0000ffull;
  x = (x | (x << 8)) & 0x100f00f00f00f00full;
  x = (x | (x << 4)) & 0x10c30c30c30c30c3ull;
  return (x | (x << 2)) & 0x1249249249249249ull;
}

// Morton code of the middle of the box, with the world in the upper bits, so that each world is a subtree.
constexpr int kWorldShift = 32;
PGCCD_HD uint64_t lbvh_key(const BroadBodies& bodies, const LbvhFrame& frame, int64_t body) {
  constexpr int kDigits = 21, kDigitsBelowWorld = 10;
  if (bodies.is_absent(body)) return ~uint64_t{0};  // after all others
  const Vec3<double> middle = middle_of(swept_box(bodies, body));
  uint64_t code = 0;
  for (int k = 0; k < 3; ++k) {
    const double offset = component(middle, k) - frame.origin[k];
    const double unit = 0.5 + 0.5 * (offset / (std::fabs(offset) + frame.spread));
    const double last = static_cast<double>((1 << kDigits) - 1);
    code |= spread_bits(static_cast<uint64_t>(larger(0.0, smaller(unit * (last + 1.0), last)))) << k;
  }
  if (!bodies.world) return code;
  const uint64_t world = static_cast<uint32_t>(bodies.world[body]);
  return (world << kWorldShift) | (code >> (3 * (kDigits - kDigitsBelowWorld)));
}

// Bodies' sizes, and those of their subtrees, in octaves.
PGCCD_HD int32_t octave(const FilterBox& box) {
  return static_cast<int32_t>(std::bit_cast<uint32_t>(box.radius) >> 23);
}

// Node k separates its leaves between k and k + 1. Negative children are leaves: ~index. Begins like a FilterBox.
struct alignas(16) LbvhNode {
  float lower[3];
  int32_t top_octave;
  float minus_upper[3];
  int32_t last;  // leaf
  int32_t first;
  int32_t left, right;
  int32_t padding;
};

// True if leaves k and k + 1 have a shorter common prefix than leaves m and m + 1. Equal keys are ordered by index.
PGCCD_HD bool divides_above(const uint64_t* keys, int64_t k, int64_t m) {
  const uint64_t at_k = keys[k] ^ keys[k + 1], at_m = keys[m] ^ keys[m + 1];
  if (at_k != at_m) return at_k > at_m;
  return (k ^ (k + 1)) > (m ^ (m + 1));
}

struct LbvhTree {
  const uint64_t* keys;  // sorted
  const FilterBox* leaves;
  LbvhNode* nodes;  // leaf_count - 1
  int64_t leaf_count;
  bool has_worlds;
};

PGCCD_HD LbvhNode leaf_node(const FilterBox& box, int32_t position) {
  return {{box.lower[0], box.lower[1], box.lower[2]},
          octave(box),
          {box.minus_upper[0], box.minus_upper[1], box.minus_upper[2]},
          position,
          position,
          0,
          0,
          0};
}

// The parent of a subtree other than the whole tree.
PGCCD_HD int32_t parent_of(const LbvhTree& tree, const LbvhNode& subtree) {
  if (subtree.first == 0) return subtree.last;
  if (subtree.last == tree.leaf_count - 1) return subtree.first - 1;
  return divides_above(tree.keys, subtree.first - 1, subtree.last) ? subtree.last : subtree.first - 1;
}

// Builds the nodes above leaf p as long as this thread is the second child to arrive. arrive(node) returns whether it
// is; it must acquire the writes of the first child and release those of this one. Returns the root to the last thread.
template <class Arrive>
PGCCD_HD int32_t climb(const LbvhTree& tree, int32_t p, Arrive&& arrive) {
  LbvhNode subtree = leaf_node(tree.leaves[p], p);
  int32_t reference = ~p;
  for (;;) {
    const int32_t parent = parent_of(tree, subtree);
    LbvhNode& node = tree.nodes[parent];
    const bool on_the_left = subtree.last == parent;
    (on_the_left ? node.left : node.right) = reference;
    if (!arrive(parent)) return -1;
    const int32_t other = on_the_left ? node.right : node.left;
    const LbvhNode sibling = other < 0 ? leaf_node(tree.leaves[~other], ~other) : tree.nodes[other];
    for (int k = 0; k < 3; ++k) {
      subtree.lower[k] = smaller(subtree.lower[k], sibling.lower[k]);
      subtree.minus_upper[k] = smaller(subtree.minus_upper[k], sibling.minus_upper[k]);
    }
    subtree.top_octave = larger(subtree.top_octave, sibling.top_octave);
    subtree.first = smaller(subtree.first, sibling.first);
    subtree.last = larger(subtree.last, sibling.last);
    subtree.left = on_the_left ? reference : other;
    subtree.right = on_the_left ? other : reference;
    node = subtree;
    reference = parent;
    if (subtree.first == 0 && subtree.last == tree.leaf_count - 1) return reference;
  }
}

// Each node on a path from the root fixes one more bit of (key, index).
constexpr int kLongestPath = 64 + 31;

// Calls found(q) for leaves q to be tested with leaf p. overlaps(bounds) compares a node or leaf with p's box.
template <class Overlaps, class Found>
PGCCD_HD void traverse_lbvh(const LbvhTree& tree, int32_t root, int32_t p, Overlaps&& overlaps, Found&& found) {
  const int32_t own_octave = octave(tree.leaves[p]);
  const uint64_t own_world = tree.keys[p] >> kWorldShift;
  int32_t stack[kLongestPath + 1];
  int size = 0;
  for (int32_t node = root;;) {
    const int32_t children[2] = {tree.nodes[node].left, tree.nodes[node].right};
    int32_t next = -1;
    for (const int32_t child : children) {
      if (child < 0) {
        const int32_t q = ~child;
        const int32_t other = octave(tree.leaves[q]);
        if ((other > own_octave || (other == own_octave && q > p)) && overlaps(tree.leaves[q])) found(q);
        continue;
      }
      const LbvhNode& below = tree.nodes[child];
      if (below.top_octave < own_octave || (below.top_octave == own_octave && below.last <= p)) continue;
      if (!overlaps(below)) continue;
      if (tree.has_worlds &&
          (tree.keys[below.first] >> kWorldShift > own_world || tree.keys[below.last] >> kWorldShift < own_world)) {
        continue;
      }
      if (next >= 0) stack[size++] = next;
      next = child;
    }
    if (next >= 0) {
      node = next;
    } else if (size > 0) {
      node = stack[--size];
    } else {
      return;
    }
  }
}

}  // namespace pgccd
