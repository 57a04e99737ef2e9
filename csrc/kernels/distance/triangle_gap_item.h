// Two triangles at one time and over a part of the step: nearest points, and lower bounds of their distance.
#pragma once

#include "kernels/distance/node_gap_item.h"
#include "kernels/narrow/crossing.h"
#include "kernels/narrow/nearest_points.h"

namespace pgccd {

struct Corners3 {
  Vec3<double> x[3];
};

// A point of a triangle by the weights of its corners, which add up to 1 but for rounding and are not negative.
struct Weights {
  double w[3];

  PGCCD_HD Vec3<double> of(const Corners3& t) const { return w[0] * t.x[0] + (w[1] * t.x[1] + w[2] * t.x[2]); }
};

struct NearestOfTriangles {
  double squared = INFINITY;
  Vec3<double> direction{0.0, 0.0, 0.0};  // from the first to the second, of any length
  Weights weights[2] = {};
};

namespace gap_detail {

PGCCD_HD int next_corner(int c) { return c == 2 ? 0 : c + 1; }

PGCCD_HD Weights on_face(double u, double v) { return {{1.0 - (u + v), u, v}}; }
PGCCD_HD Weights on_edge(int c, double s) {
  Weights out{};
  out.w[c] = 1.0 - s;
  out.w[next_corner(c)] = s;
  return out;
}
PGCCD_HD Weights at_corner(int c) { return on_edge(c, 0.0); }

}  // namespace gap_detail

// The nearest of the six pairs of a vertex and a face and the nine of two edges. That of triangles that pass through
// one another is not zero.
PGCCD_HD NearestOfTriangles nearest_of_triangles(const Corners3& a, const Corners3& b) {
  using namespace gap_detail;
  NearestOfTriangles best;
  const auto is_nearer = [&](const Nearest<double>& found, double sign) {
    const double squared = norm_squared(found.offset);
    if (!(squared < best.squared)) return false;
    best.squared = squared;
    best.direction = sign * (max_abs(found.direction) > 0.0 ? found.direction : found.offset);
    return true;
  };
  PGCCD_KEEP_LOOP
  for (int k = 0; k < 6; ++k) {
    const int c = k < 3 ? k : k - 3;
    const Corners3 &face = k < 3 ? b : a, &other = k < 3 ? a : b;
    const auto found = nearest_points<FeatureKind::kVertexFace>(
        feature_pair<FeatureKind::kVertexFace>(other.x[c], face.x[0], face.x[1], face.x[2]));
    if (!is_nearer(found, k < 3 ? 1.0 : -1.0)) continue;
    best.weights[k < 3 ? 0 : 1] = at_corner(c);
    best.weights[k < 3 ? 1 : 0] = on_face(found.u, found.v);
  }
  PGCCD_KEEP_LOOP
  for (int k = 0; k < 9; ++k) {
    const int c = k / 3, d = k % 3;
    const auto found = nearest_points<FeatureKind::kEdgeEdge>(
        feature_pair<FeatureKind::kEdgeEdge>(a.x[c], a.x[next_corner(c)], b.x[d], b.x[next_corner(d)]));
    if (!is_nearer(found, 1.0)) continue;
    best.weights[0] = on_edge(c, found.u);
    best.weights[1] = on_edge(d, found.v);
  }
  return best;
}

PGCCD_HD double most_along(const Corners3& t, Vec3<double> d) {
  return larger(larger(dot(d, t.x[0]), dot(d, t.x[1])), dot(d, t.x[2]));
}
PGCCD_HD double least_along(const Corners3& t, Vec3<double> d) {
  return smaller(smaller(dot(d, t.x[0]), dot(d, t.x[1])), dot(d, t.x[2]));
}
// The gap of two triangles along a direction.
PGCCD_HD double gap_along(const Corners3& a, const Corners3& b, Vec3<double> d) {
  return least_along(b, d) - most_along(a, d);
}

// Projections on a direction n(s) = (1 - s) d0 + s d1 that turns, of points that move, as control points of quadratics:
// at the first end, in the middle and at the last end.
struct TurningRange {
  double at[3];
};
PGCCD_HD TurningRange most_along(const Corners3& start, const Corners3& end, const Vec3<double> (&d)[2]) {
  double middle = -INFINITY;
  for (int c = 0; c < 3; ++c) middle = larger(dot(d[0], end.x[c]) + dot(d[1], start.x[c]), middle);
  return {{most_along(start, d[0]), 0.5 * middle, most_along(end, d[1])}};
}
PGCCD_HD TurningRange least_along(const Corners3& start, const Corners3& end, const Vec3<double> (&d)[2]) {
  const TurningRange most = most_along(start, end, {-d[0], -d[1]});
  return {{-most.at[0], -most.at[1], -most.at[2]}};
}

// A lower bound of the distance, given the largest projections of the first and the least of the second, without
// rounding: the offset x(s) of two points has n(s) . x(s) above the quadratic, less bend s (1 - s), and |n(s)| =
// sqrt(1 - 2 s (1 - s) m) with m = 1 - d0 . d1. So where the quadratic is at least q > 0, the distance is at least that
// of the quadratic plus m s (1 - s) q.
PGCCD_HD double turning_gap(const TurningRange& most, const TurningRange& least, const Vec3<double> (&d)[2],
                            double bend) {
  const double first = least.at[0] - most.at[0], last = least.at[2] - most.at[2];
  const double middle = (least.at[1] - most.at[1]) - 0.5 * bend;
  const double gap = least_of_quadratic(first, middle, last);
  if (!(gap > 0.0)) return gap;
  const double shorter = larger(1.0 - dot(d[0], d[1]), 0.0);
  return least_of_quadratic(first, middle + 0.5 * (shorter * gap), last);
}

// Whether an edge of one certainly passes through the other, given the error of the points; if so, `points` are the
// place on each where it does.
PGCCD_HD_RARE inline bool certainly_intersect(const Corners3& a, const Corners3& b, double point_error,
                                              Vec3<double> (&points)[2]) {
  const auto never = [] { return EdgeAndFace<DoubleDouble>{}; };
  for (int k = 0; k < 6; ++k) {
    const int c = k < 3 ? k : k - 3;
    const Corners3 &of_edge = k < 3 ? a : b, &face = k < 3 ? b : a;
    const EdgeAndFace<double> x{{of_edge.x[c], of_edge.x[gap_detail::next_corner(c)], face.x[0], face.x[1], face.x[2]}};
    if (passes_through(x, point_error, never, false) != Crossing::kPasses) continue;
    const FacePoint at = crossing_point(in_double_double(x), size_of(x));
    const Vec3<double> on_face = gap_detail::on_face(at.u, at.v).of(face), along = x.point[1] - x.point[0];
    const double s = unit_clamp(dot(on_face - x.point[0], along) / norm_squared(along));
    points[k < 3 ? 1 : 0] = on_face;
    points[k < 3 ? 0 : 1] = (1.0 - s) * x.point[0] + s * x.point[1];
    return true;
  }
  return false;
}

}  // namespace pgccd
