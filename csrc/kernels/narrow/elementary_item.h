// One elementary query on straight paths; the given points are exact.
#pragma once

#include "core/fixed_directions.h"
#include "kernels/narrow/precision_ladder.h"

namespace pgccd {

// Rows of the outputs.
template <class T>
struct ElementaryColumns {
  int8_t* status;
  T* toi;
  T* coordinates;  // (., 2)
  int8_t* significant_bits;
};

// Four points (., 3) at one end of the step, as differences in float32.
template <FeatureKind kKind, class T>
PGCCD_HD FeaturePair<float> rounded_differences(const T* points) {
  const FeaturePair<T> p =
      feature_pair<kKind>(load_vec3(points), load_vec3(points + 3), load_vec3(points + 6), load_vec3(points + 9));
  return {cast<float>(p.r), cast<float>(p.a), cast<float>(p.b)};
}

// The largest distance of a reported contact, rounded up.
PGCCD_HD float cull_distance(const NarrowSettings& settings) {
  return round_up<float>((settings.separation + settings.tolerance) * (1.0 + 0x1p-50));
}

template <class T>
PGCCD_HD Answer<T> culled_answer() {
  return {{Status::kFree, static_cast<T>(INFINITY), T(0), T(0)}, 24};
}

// A query that was not culled.
template <FeatureKind kKind, class T>
PGCCD_HD Answer<T> solve_elementary(const T* points_t0, const T* points_t1, const NarrowSettings& settings) {
  const Vec3<T> t0[4] = {load_vec3(points_t0), load_vec3(points_t0 + 3), load_vec3(points_t0 + 6),
                         load_vec3(points_t0 + 9)};
  const Vec3<T> t1[4] = {load_vec3(points_t1), load_vec3(points_t1 + 3), load_vec3(points_t1 + 6),
                         load_vec3(points_t1 + 9)};
  return solve_straight<kKind>(
      t0, t1, {settings.separation, settings.tolerance, static_cast<double>(INFINITY), settings.nonzero_toi});
}

template <class T>
PGCCD_HD void store(const ElementaryColumns<T>& out, int64_t row, const Answer<T>& answer) {
  out.status[row] = static_cast<int8_t>(answer.outcome.status);
  out.toi[row] = answer.outcome.toi;
  out.coordinates[2 * row] = answer.outcome.u;
  out.coordinates[2 * row + 1] = answer.outcome.v;
  out.significant_bits[row] = answer.significant_bits;
}

}  // namespace pgccd
