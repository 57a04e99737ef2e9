// Feature pairs in columns on the host, one lane each.
#pragma once

#include "core/feature_pair.h"
#include "core/lanes.h"

namespace pgccd {

class FeatureLanes {
 public:
  void set(int lane, const FeaturePair<float>& p) {
    const Vec3<float> vectors[3] = {p.r, p.a, p.b};
    for (int k = 0; k < 3; ++k) {
      column_[3 * k][lane] = vectors[k].x;
      column_[3 * k + 1][lane] = vectors[k].y;
      column_[3 * k + 2][lane] = vectors[k].z;
    }
  }
  void copy(int lane, const FeatureLanes& from, int its_lane) {
    for (int k = 0; k < 9; ++k) column_[k][lane] = from.column_[k][its_lane];
  }
  FeaturePair<Float8> pairs() const { return {vector(0), vector(1), vector(2)}; }

 private:
  Vec3<Float8> vector(int k) const {
    return {load<Float8>(column_[3 * k]), load<Float8>(column_[3 * k + 1]), load<Float8>(column_[3 * k + 2])};
  }

  alignas(32) float column_[9][kLanes] = {};
};

}  // namespace pgccd
