// From pairs of leaves to candidates on the host, eight triangles at a time.
#pragma once

#include "kernels/traverse/feature_queue_host.h"
#include "kernels/traverse/leaf_separation.h"
#include "kernels/traverse/time_windows.h"

namespace pgccd {

inline MovingPoints<3, float> one_lane(const MovingPoints<3, Float8>& points, int lane) {
  MovingPoints<3, float> out;
  for (int c = 0; c < 3; ++c) {
    out.start[c] = {points.start[c].x[lane], points.start[c].y[lane], points.start[c].z[lane]};
    out.end[c] = {points.end[c].x[lane], points.end[c].y[lane], points.end[c].z[lane]};
  }
  return out;
}

template <int N>
MovingPoints<N, Float8> in_all_lanes(const MovingPoints<N, float>& points) {
  MovingPoints<N, Float8> out;
  for (int k = 0; k < N; ++k) {
    out.start[k] = broadcast(points.start[k]);
    out.end[k] = broadcast(points.end[k]);
  }
  return out;
}

// Calls emit(lane, bit) for edges and faces of one triangle and others, the lanes `near`, that may pass through one
// another at t = 0.
template <class Bodies, class Emit>
void find_crossings(const PairTree<Bodies>& tree, const Triangle& one, const Triangle* others,
                    const Vec3<Float8> (&at_one)[3], const Vec3<Float8> (&at_others)[3], uint32_t near, Emit&& emit) {
  const float distance = tree.sweep().start_distance;
  const bool is_one_body = tree.sweep().is_one_body();
  // The planes of neighbouring triangles of one surface do not separate them.
  if (!is_one_body) {
    near &= ~lane_bits(planes_separate(at_one, at_others, distance, lanes_without(near)));
    if (near != 0) near &= ~lane_bits(edges_separate(at_one, at_others, distance, lanes_without(near)));
  }
  if (near == 0) return;
  const auto corner = [&](int side, int index) { return side == 0 ? at_one[index] : at_others[index]; };
  uint32_t lanes[kCrossingBits] = {};
  for_each_bit(near, [&](int lane) {
    for_each_bit(represented_crossings(one, others[lane], is_one_body), [&](int bit) { lanes[bit] |= 1u << lane; });
  });
  for (int bit = 0; bit < kCrossingBits; ++bit) {
    if (lanes[bit] == 0) continue;
    const Mask8 apart = crossing_apart(corner, bit, distance, lanes_without(lanes[bit]));
    for_each_bit(lanes[bit] & ~lane_bits(apart), [&](int lane) { emit(lane, bit); });
  }
}

// Triangles of a leaf, one bit each, that may reach into the other leaf's sphere over segment k.
template <class Bodies>
uint32_t triangles_reaching(const PairTree<Bodies>& tree, const MovingPoints<3, Float8>& triangles, int count, int side,
                            int32_t other_leaf, int k) {
  const float reach = tree.local_radius(1 - side, other_leaf) + tree.sweep().inflation;
  const MovingPoints<1, Float8> centre = in_all_lanes(tree.moving_centre(1 - side, other_leaf, k));
  return ((1u << count) - 1u) & ~lane_bits(stays_out(triangles, centre, reach));
}

// The time until which the leaves certainly stay apart: in `windows` of the step, if the pair turns fast.
template <class Bodies>
float leaves_free_until(const PairTree<Bodies>& tree, NodePair leaves, Windows windows) {
  if (!tree.sweep().turns_fast()) return leaves_free_until<Float8>(tree, leaves);
  float begin = kNeverMeet;
  for_each_window(tree, windows, [&](int, TimeSpan range) {
    if (begin != kNeverMeet) return;
    begin = separation_detail::leaves_free_while_turning<Float8>(tree, leaves, range);
  });
  return begin;
}

// One triangle of the first leaf against all of the second's at a time. `begin`: the time until which the leaves
// certainly stay apart, or kUnknownBegin.
constexpr float kUnknownBegin = -1.0f;
template <class Bodies, class Emit>
void visit_leaves(const PairTree<Bodies>& tree, NodePair leaves, Windows windows, float begin, Emit&& emit) {
  const NodeLink first = tree.link(0, leaves.first), second = tree.link(1, leaves.second);
  if (first.triangle_count < 0 || second.triangle_count < 0) return;
  if (begin == kUnknownBegin) begin = leaves_free_until(tree, leaves, windows);
  if (begin == kNeverMeet) return;
  const bool may_start_near = !(begin > 0.0f) && tree.sweep().start_distance >= 0.0f;
  const auto triangles = [&](int side) { return tree.bodies().meshes.triangles + tree.sweep().first_face[side]; };
  const Triangle *first_triangles = triangles(0) + first.first, *second_triangles = triangles(1) + second.first;
  const bool is_one_body = tree.sweep().is_one_body(), is_one_leaf = is_one_body && leaves.first == leaves.second;
  uint32_t meeting[kMaxLeafTriangles][kLanes] = {};
  const auto mark_meeting = [&](int number) { meeting[number >> 7][number >> 4 & 7] |= 1u << (number & 15); };
  FeatureTests tests(mark_meeting);
  // Segment k of `over`; `is_start`: at the start of the step. Spans of several segments are only tested.
  const auto visit = [&](const PairTree<Bodies>& over, int k, bool is_start, bool is_single) {
    const float distance = over.sweep().inflation;
    const MovingPoints<3, Float8> i = moving_triangles<Float8>(over, 0, first.first, k);
    const uint32_t reaching_i = triangles_reaching(over, i, first.triangle_count, 0, leaves.second, k);
    if (reaching_i == 0) return Then::kNext;
    const MovingPoints<3, Float8> j = moving_triangles<Float8>(over, 1, second.first, k);
    const uint32_t reaching_j = triangles_reaching(over, j, second.triangle_count, 1, leaves.first, k);
    if (reaching_j == 0) return Then::kNext;
    if (!is_single) return Then::kDivide;
    for_each_bit(reaching_i, [&](int p) {
      const MovingPoints<3, float> one = one_lane(i, p);
      const MovingPoints<3, Float8> same = in_all_lanes(one);
      const uint32_t mirrored = is_one_leaf ? (2u << p) - 1u : 0u;
      const uint32_t near = reaching_j & ~lane_bits(triangles_stay_apart(same, j, distance)) & ~mirrored;
      if (is_start && may_start_near && near != 0) {
        find_crossings(tree, first_triangles[p], second_triangles, same.start, j.start, near, [&](int lane, int bit) {
          emit_crossing(first_triangles[p], second_triangles[lane], bit, is_one_body, emit);
        });
      }
      for_each_bit(near, [&](int lane) {
        const Triangle &first_triangle = first_triangles[p], &second_triangle = second_triangles[lane];
        uint32_t wanted = represented_pairs(first_triangle, second_triangle) & ~meeting[p][lane];
        if (is_one_body) wanted &= pairs_without_common_vertex(first_triangle, second_triangle);
        if (wanted == 0) return;
        const MovingPoints<3, float> other = one_lane(j, lane);
        const auto corner = [&](int side, int index, int end) {
          const MovingPoints<3, float>& points = side == 0 ? one : other;
          return end == 0 ? points.start[index] : points.end[index];
        };
        for_each_bit(wanted,
                     [&](int bit) { tests.add(moving_features(corner, bit), (p << 3 | lane) << 4 | bit, distance); });
      });
    });
    tests.finish(distance);
    return Then::kNext;
  };
  if (tree.sweep().turns_fast()) {
    for_each_window(tree, windows, [&](int, TimeSpan range) {
      walk_spans(tree, range, [&](const PairTree<Bodies>& over, TimeSpan span) {
        return visit(over, 1, span.begin == 0, span.length() == 1);
      });
    });
  } else {
    for (int k = 1; k <= tree.sweep().segment_count; ++k) visit(tree, k, k == 1, true);
  }
  for (int p = 0; p < first.triangle_count; ++p) {
    for (int lane = 0; lane < second.triangle_count; ++lane) {
      for_each_bit(meeting[p][lane],
                   [&](int bit) { emit_pair(first_triangles[p], second_triangles[lane], bit, is_one_body, emit); });
    }
  }
}

// The time until which the leaves certainly stay apart, for the order in which pairs of leaves are searched.
template <class Bodies>
float begin_of(const PairTree<Bodies>& tree, NodePair leaves, Windows windows) {
  if (tree.link(0, leaves.first).triangle_count < 0 || tree.link(1, leaves.second).triangle_count < 0) {
    return kNeverMeet;
  }
  // Leaves this near may meet from the start: the time only decides what is searched first.
  const Vec3<float> offset = tree.centre_at_start(1, leaves.second) - tree.centre_at_start(0, leaves.first);
  if (norm_squared(offset) < tree.sweep().inflation * tree.sweep().inflation) return 0.0f;
  return leaves_free_until(tree, leaves, windows);
}

}  // namespace pgccd
