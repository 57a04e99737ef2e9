// A test by samples of the support functions of two nodes (core/mesh_set.h), for what the tests of spheres and slabs
// leave. T is float or, on the host, eight lanes of it.
#pragma once

#include "kernels/traverse/time_spans.h"

namespace pgccd {

namespace support_detail {

// An upper bound of a support function in units of kSupportStep times the node's radius. It is convex and positively
// homogeneous, so on a cell of the cube's face it is at most the bilinear interpolation of the samples at the corners.
// `word`: returns a word of the node's samples, one per lane. NaN for a direction of no length or with a NaN.
template <class T, class Word>
PGCCD_HD T bound(Vec3<T> direction, Word&& word) {
  const T zero = T{}, one = zero + 1.0f, two = zero + 2.0f;
  const T x = larger(direction.x, -direction.x), y = larger(direction.y, -direction.y),
          z = larger(direction.z, -direction.z);
  const auto along_y = y >= z;
  const auto along_x = x >= larger(y, z);
  const T length = larger(x, larger(y, z));
  const T side = along_x ? direction.x : (along_y ? direction.y : direction.z);
  const T first = along_x ? direction.y : (along_y ? direction.z : direction.x);
  const T second = along_x ? direction.z : (along_y ? direction.x : direction.y);
  // From 0 to kSupportCells, to within rounding.
  const T to_cells = (0.5f * kSupportCells) / length;
  const T p = first * to_cells + 0.5f * kSupportCells, q = second * to_cells + 0.5f * kSupportCells;
  static_assert(kSupportCells == 3);
  const T cell_p = (p >= one ? one : zero) + (p >= two ? one : zero);
  const T cell_q = (q >= one ? one : zero) + (q >= two ? one : zero);
  constexpr float kRows = kSupportCells + 1;
  const T face = (along_x ? zero : (along_y ? zero + 2.0f : zero + 4.0f)) + (side < zero ? one : zero);
  const auto row = to_integer(kRows * face + cell_p), shift = to_integer(8.0f * cell_q);
  const auto here = word(row), next = word(row + 1);
  const auto sample = [](auto bits) { return to_number(bits & 0xff); };
  const auto interpolated = [](T from, T to, T part) { return multiply_add(part, to - from, from); };
  const T part = q - cell_q;
  const T low = interpolated(sample(here >> shift), sample(here >> (shift + 8)), part);
  const T high = interpolated(sample(next >> shift), sample(next >> (shift + 8)), part);
  return length * interpolated(low, high, p - cell_p);
}

}  // namespace support_detail

// True where the children of a split from `slot` on, as many as T has lanes, certainly stay apart from the other node
// over segment k, along the mean of the line from its centre to theirs: a fixed direction (see `separates`), along
// which a node reaches as far from its centre as its support function in the directions pulled back at both ends. The
// error of all this is below 32 units of rounding; the inflation includes 64. The direction has unit length: with large
// bodies, the scale of the poses times that of centres near one another would underflow.
template <class T>
PGCCD_HD auto supports_separate(const PairTree<RigidBodies>& tree, const SplitPair& split, int k, int slot) {
  const RigidSweep& sweep = tree.sweep();
  const int side = split.side(), other_side = 1 - side;
  const NodeBlock &block = sweep.blocks[side][split.block()],
                  &other_block = sweep.blocks[other_side][block_of(split.other())];
  const int other_slot = slot_of(split.other());
  const Vec3<T> centre{load<T>(block.x + slot), load<T>(block.y + slot), load<T>(block.z + slot)};
  const Vec3<float> other_centre{other_block.x[other_slot], other_block.y[other_slot], other_block.z[other_slot]};
  const auto offset = [&](const LocalPose& pose) {
    return RigidSweep::place(pose.of[side], centre) -
           in_all_lanes(RigidSweep::place(pose.of[other_side], other_centre), T{});
  };
  const Vec3<T> start = offset(tree.pose(k - 1)), end = offset(tree.pose(k)), sum = start + end;
  const T length_squared = norm_squared(sum);
  auto apart = length_squared > 1e-30f;
  const Vec3<T> direction = (1.0f / square_root(length_squared)) * sum;
  const float least_gap = sweep.inflation * (1.0f + 8.0f * Precision<float>::unit);
  const T along_start = dot(direction, start), along_end = dot(direction, end);
  const T reach = load<T>(block.radius + slot) * kSupportStep;
  const float other_reach = other_block.radius[other_slot] * kSupportStep;
  PGCCD_KEEP_LOOP
  for (int of = 0; of < 2; ++of) {
    const LocalPose& pose = tree.pose(k - 1 + of);
    const T above = support_detail::bound(RigidSweep::pulled_back(pose.of[other_side], direction), [&](auto word) {
      return load_at(tree.support(other_side, split.other()).rows[0], word);
    });
    const T below = support_detail::bound(RigidSweep::pulled_back(pose.of[side], -direction), [&](auto word) {
      return load_at(tree.support(side, split.node(slot)).rows[0], word + kSupportWords * lane_numbers(T{}));
    });
    const T gap = (of == 0 ? along_start : along_end) - (reach * below + other_reach * above);
    apart = apart & (gap > least_gap);
    if (!any_lane(apart)) break;
  }
  return apart;
}

// Deforming bodies have no samples.
template <class T>
PGCCD_HD auto supports_separate(const PairTree<DeformingBodies>&, const SplitPair&, int, int) {
  return T{} != T{};
}

namespace support_detail {

template <class Bodies>
PGCCD_HD bool child_may_meet(const PairTree<Bodies>& tree, const SplitPair& split, int slot) {
  for (int k = 1; k <= tree.sweep().segment_count; ++k) {
    if (may_meet(tree.clearance(split, tree.other_node(split, k), k, slot)) &&
        !supports_separate<float>(tree, split, k, slot)) {
      return true;
    }
  }
  return false;
}

// The same for a pair that turns fast.
PGCCD_HD_RARE inline bool child_may_meet_while_turning(const PairTree<RigidBodies>& tree, const SplitPair& split,
                                                       int slot) {
  SpanWalk walk({0, tree.sweep().segment_count});
  while (!walk.is_over()) {
    const SpanTree over(tree, walk.span());
    if (!child_may_meet(over.tree(), split, slot)) {
      walk.next();
    } else if (!walk.divide()) {
      return true;
    }
  }
  return false;
}

}  // namespace support_detail

// Whether a child and the other node may meet during the step. kDividesTime: as in SweepSettings, known to the
// compiler, since the rare case costs the other registers.
template <bool kDividesTime, class Bodies>
PGCCD_HD bool child_may_meet(const PairTree<Bodies>& tree, const SplitPair& split, int slot) {
  if constexpr (kDividesTime) {
    if (tree.sweep().turns_fast()) return support_detail::child_may_meet_while_turning(tree, split, slot);
  }
  return support_detail::child_may_meet(tree, split, slot);
}

// Whether the roots may: of other bodies the test of swept spheres has said so.
template <bool kDividesTime, class Bodies>
PGCCD_HD bool roots_may_meet(const PairTree<Bodies>& tree) {
  return !SweepOf<Bodies>::has_supports || child_may_meet<kDividesTime>(tree, {0, 0, 0}, 0);
}

}  // namespace pgccd
