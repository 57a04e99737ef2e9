// Pairs of which one body at least fills little of its SBV: whether their moving boxes stay apart.
#pragma once

#include "core/moving_box.h"
#include "kernels/broad/body_volumes.h"

namespace pgccd {

// A pair in a local frame, scaled by a power of two so that all coordinates are below 1/2 in float32. Gaps along a
// direction of unit length then have a total error below 32 units of rounding (docs/explanation/exactness.md). Exchange
// of both bodies does not change a bit of them.
class BoxPair {
 public:
  PGCCD_HD BoxPair(const BroadBodies& bodies, int64_t i, int64_t j)
      : box_{bodies.boxes + i, bodies.boxes + j}, at_any_times_(bodies.at_any_times) {
    const BodyCentres& centres = bodies.centres;
    const auto place = [&](int64_t body, int end) {
      return load_vec3((end == 0 ? centres.position_t0 : centres.position_t1) + 3 * body);
    };
    Vec3<double> offset[2][2];
    double furthest = 0.0, distance = bodies.separation + pair_tolerance(centres, i, j, bodies.tolerance);
    for (int of_i = 0; of_i < 2; ++of_i) {
      for (int of_j = 0; of_j < 2; ++of_j) {
        offset[of_i][of_j] = place(j, of_j) - place(i, of_i);
        if (of_i == of_j || at_any_times_) furthest = larger(max_abs(offset[of_i][of_j]), furthest);
      }
    }
    if (at_any_times_) {  // stopped bodies are on their paths only up to the rounding of positions
      for (int end = 0; end < 2; ++end) {
        distance += 32.0 * Precision<double>::unit * larger(max_abs(place(i, end)), max_abs(place(j, end)));
      }
    }
    const double size = 2.0 * ((double{box_[0]->unit} + double{box_[1]->unit}) + furthest);
    const double scale = inverse_power_of_two(larger(size, kSmallestSize));
    for (int side = 0; side < 2; ++side) unit_[side] = static_cast<float>(scale * double{box_[side]->unit});
    for (int of_i = 0; of_i < 2; ++of_i) {
      for (int of_j = 0; of_j < 2; ++of_j) offset_[of_i][of_j] = cast<float>(scale * offset[of_i][of_j]);
    }
    const float grown = unit_[0] * box_[0]->growth + unit_[1] * box_[1]->growth;
    least_gap_ = (static_cast<float>(scale * distance) + grown) + 64.0f * Precision<float>::unit;
  }

  // True if the boxes certainly stay apart. NaN keeps a pair.
  PGCCD_HD bool stay_apart() const {
    for (int k = 0; k < direction_count(); ++k) {
      if (separates(k)) return true;
    }
    return false;
  }

  // The directions in which the boxes may be apart, and whether they certainly are in the k-th.
  PGCCD_HD int direction_count() const {
    return box_[0]->is_slender() && box_[1]->is_slender() ? 2 * kEdges + kEdges * kEdges : 1;
  }
  PGCCD_HD bool separates(int k) const {
    if (direction_count() == 1) return separates(towards_point());
    // The long edges first: they separate most pairs of rods.
    constexpr int kFirstCross = 1 + 2 * kEdges;
    const int pair_of_edges = k == 0 ? 0 : k - kFirstCross + 1;
    const bool is_face = k > 0 && k < kFirstCross;
    return separates(is_face ? mean_edge((k - 1) / kEdges, (k - 1) % kEdges)
                             : cross(mean_edge(0, pair_of_edges / kEdges), mean_edge(1, pair_of_edges % kEdges)));
  }

 private:
  static constexpr int kEdges = 3;

  // Smaller pairs are within the rounding of the local frame.
  static constexpr double kSmallestSize = 0x1p-126;

  PGCCD_HD Vec3<float> mean_edge(int side, int k) const { return box_[side]->half[0][k] + box_[side]->half[1][k]; }

  // Of two bodies one without a box: the direction from the nearest point of the other's, midway.
  PGCCD_HD Vec3<float> towards_point() const {
    const auto middle = [&](int side) {
      return (0.5f * unit_[side]) * (box_[side]->centre[0] + box_[side]->centre[1]);
    };
    Vec3<float> offset = 0.5f * (offset_[0][0] + offset_[1][1]) + (middle(1) - middle(0));
    const int side = box_[0]->is_slender() ? 0 : 1;
    for (int k = 0; k < 3; ++k) {
      const Vec3<float> half = (0.5f * unit_[side]) * mean_edge(side, k);
      const float part = dot(offset, half) / norm_squared(half);
      offset = offset - larger(smaller(part, 1.0f), -1.0f) * half;
    }
    return offset;
  }

  // Along a fixed direction the gap of two convex sets whose points move straight is concave in time: above a distance
  // at both ends, it is above it throughout. At any two times it is least at two of the ends.
  PGCCD_HD bool separates(Vec3<float> along) const {
    const float length_squared = norm_squared(along);
    if (!(length_squared > 1e-30f)) return false;
    const Vec3<float> direction = (1.0f / square_root(length_squared)) * along;
    float middle[2][2], reach[2][2];  // of each side at both ends
    for (int side = 0; side < 2; ++side) {
      for (int end = 0; end < 2; ++end) {
        const Vec3<float>(&half)[3] = box_[side]->half[end];
        float edges = 0.0f;
        for (int k = 0; k < 3; ++k) edges += magnitude(dot(half[k], direction));
        middle[side][end] = unit_[side] * dot(box_[side]->centre[end], direction);
        reach[side][end] = unit_[side] * edges;
      }
    }
    const auto apart = [&](int of_i, int of_j) {
      return dot(offset_[of_i][of_j], direction) + (middle[1][of_j] - middle[0][of_i]);
    };
    const float sign = apart(0, 0) + apart(1, 1) < 0.0f ? -1.0f : 1.0f;
    const auto has_gap = [&](int of_i, int of_j) {
      return sign * apart(of_i, of_j) - (reach[0][of_i] + reach[1][of_j]) > least_gap_;
    };
    return has_gap(0, 0) && has_gap(1, 1) && (!at_any_times_ || (has_gap(0, 1) && has_gap(1, 0)));
  }

  const MovingBox* box_[2];
  bool at_any_times_;
  float unit_[2];
  Vec3<float> offset_[2][2];  // of the second SBV centre from the first, each at one end
  float least_gap_;
};

// False only if the bodies certainly do not come within separation + tolerance. Of two bodies without boxes the swept
// spheres decide.
PGCCD_HD bool boxes_may_meet(const BroadBodies& bodies, int64_t i, int64_t j) {
  if (!bodies.boxes[i].is_slender() && !bodies.boxes[j].is_slender()) return true;
  return !BoxPair(bodies, i, j).stay_apart();
}

// Whether a pair is in the PCS. Requires i < j. kMayHaveBoxes: false where bodies.boxes are known to be null.
template <bool kMayHaveBoxes = true>
PGCCD_HD bool is_potentially_colliding(const BroadBodies& bodies, int64_t i, int64_t j) {
  if (!spheres_may_meet(bodies, i, j)) return false;
  return !kMayHaveBoxes || bodies.boxes == nullptr || boxes_may_meet(bodies, i, j);
}

}  // namespace pgccd
