// Tests of the bounding volume test tree: do two moving spheres, or two moving triangles, certainly stay apart over a
// segment?
#pragma once

#include "kernels/traverse/pair_sweep.h"

namespace pgccd {

// Offset of one centre from the other, at the start and the end of a segment, both moving straight. Without branches, so that eight tests
// fill the lanes of a vector unit; NaN (an empty slot) compares false.
PGCCD_HD bool spheres_meet(Vec3<float> start, Vec3<float> end, float reach) {
  const Vec3<float> travel = end - start;
  const float nearest = unit_clamp(-dot(start, travel) / norm_squared(travel));  // 0 / 0 becomes 0
  return norm_squared(start + nearest * travel) <= reach * reach;
}

struct MovingTriangle {
  Vec3<float> start[3];
  Vec3<float> end[3];
};

namespace overlap_detail {

struct Range {
  float lower, upper;
};

PGCCD_HD Range project(const Vec3<float> x[3], Vec3<float> direction) {
  const float p = dot(direction, x[0]), q = dot(direction, x[1]), r = dot(direction, x[2]);
  return {smaller(smaller(p, q), r), larger(larger(p, q), r)};
}

// Along a fixed direction the gap between straight-moving convex sets is concave in time: open at both ends, it is open
// throughout.
PGCCD_HD bool separates(const MovingTriangle& i, const MovingTriangle& j, Vec3<float> direction, float distance) {
  const float length_squared = norm_squared(direction);
  if (!(length_squared > 1e-30f)) return false;
  const float gap = distance * std::sqrt(length_squared) * (1.0f + 8.0f * Precision<float>::unit);
  const Range i0 = project(i.start, direction), j0 = project(j.start, direction);
  const Range i1 = project(i.end, direction), j1 = project(j.end, direction);
  return (j0.lower - i0.upper > gap && j1.lower - i1.upper > gap) ||
         (i0.lower - j0.upper > gap && i1.lower - j1.upper > gap);
}

PGCCD_HD Vec3<float> mean_normal(const MovingTriangle& t) {
  const Vec3<float> a = (t.start[1] - t.start[0]) + (t.end[1] - t.end[0]);
  const Vec3<float> b = (t.start[2] - t.start[0]) + (t.end[2] - t.end[0]);
  return cross(a, b);
}

PGCCD_HD Vec3<float> corner_sum(const Vec3<float> x[3]) { return (x[0] + x[1]) + x[2]; }

}  // namespace overlap_detail

// False only if the triangles certainly stay further apart than `distance` over the whole segment.
PGCCD_HD bool triangles_may_meet(const MovingTriangle& i, const MovingTriangle& j, float distance) {
  using namespace overlap_detail;
  const Vec3<float> start = corner_sum(j.start) - corner_sum(i.start);
  const Vec3<float> end = corner_sum(j.end) - corner_sum(i.end);
  if (separates(i, j, start + end, distance)) return false;
  if (separates(i, j, mean_normal(i), distance)) return false;
  if (separates(i, j, mean_normal(j), distance)) return false;
  if (separates(i, j, start, distance)) return false;
  if (separates(i, j, end, distance)) return false;
  return true;
}

}  // namespace pgccd
