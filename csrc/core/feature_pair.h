// A vertex-face or edge-edge pair at one time, as three difference vectors, independent of its position in space:
//   vertex-face (x0 vertex; x1, x2, x3 face):    r = x1 - x0, a = x2 - x1, b = x3 - x1
//   edge-edge   (x0, x1 one edge; x2, x3 other): r = x2 - x0, a = x1 - x0, b = x3 - x2
// In both, the four points are coplanar where r . (a x b) = 0.
#pragma once

#include "core/candidate.h"
#include "core/vec3.h"

namespace pgccd {

template <class T>
struct FeaturePair {
  Vec3<T> r, a, b;
};

template <FeatureKind kKind, class T>
PGCCD_HD FeaturePair<T> feature_pair(Vec3<T> x0, Vec3<T> x1, Vec3<T> x2, Vec3<T> x3) {
  if constexpr (kIsEdgeEdge<kKind>) return {x2 - x0, x1 - x0, x3 - x2};
  return {x1 - x0, x2 - x1, x3 - x1};
}

// Sum of the largest coordinates: an upper bound of every coordinate of every difference of two of the points.
template <class T>
PGCCD_HD T extent(const FeaturePair<T>& p) {
  return (max_abs(p.r) + max_abs(p.a)) + max_abs(p.b);
}

}  // namespace pgccd
