// Whether an edge passes through a face, by the exact signs of five determinants.
#pragma once

#include "core/exact_volume.h"
#include "core/rounding.h"

namespace pgccd {

// The end points of an edge, 0 and 1, and the corners of a face, 2 to 4.
template <class T>
struct EdgeAndFace {
  Vec3<T> point[5];
};

PGCCD_HD const EdgeAndFace<DoubleDouble>& in_double_double(const EdgeAndFace<DoubleDouble>& x) { return x; }
PGCCD_HD EdgeAndFace<DoubleDouble> in_double_double(const EdgeAndFace<double>& x) {
  EdgeAndFace<DoubleDouble> out;
  for (int k = 0; k < 5; ++k) out.point[k] = cast<DoubleDouble>(x.point[k]);
  return out;
}

// The largest coordinate of a difference to the first point.
PGCCD_HD double size_of(const EdgeAndFace<double>& x) {
  double size = 0.0;
  for (int k = 1; k < 5; ++k) size = larger(size, max_abs(x.point[k] - x.point[0]));
  return size;
}

namespace crossing_detail {

// Points scaled by it have about unit size: products neither overflow nor, unless a distance is below 2^-450 of the
// size, underflow.
PGCCD_HD double scale_of(double size) { return inverse_power_of_two(larger(size, 0x1p-1000)); }

PGCCD_HD Vec3<DoubleDouble> scaled(double scale, const Vec3<DoubleDouble>& x) {
  const auto times = [scale](DoubleDouble c) { return DoubleDouble(scale * c.high, scale * c.low); };
  return {times(x.x), times(x.y), times(x.z)};
}

// Of (q - p) . ((s - p) x (t - p)), for four points.
PGCCD_HD double exact_volume_of(const EdgeAndFace<DoubleDouble>& x, double scale, const int (&at)[4]) {
  return exact_volume(scaled(scale, x.point[at[0]]), scaled(scale, x.point[at[1]]), scaled(scale, x.point[at[2]]),
                      scaled(scale, x.point[at[3]]));
}

enum class Sign : int32_t { kNegative = -1, kZero = 0, kPositive = 1, kOpen = 2 };
PGCCD_HD Sign sign_of(double x) { return x > 0.0 ? Sign::kPositive : (x < 0.0 ? Sign::kNegative : Sign::kZero); }

// The same in double, if rounding and the errors of the points leave no doubt; else kOpen.
PGCCD_HD Sign certain_sign(const EdgeAndFace<double>& x, double point_error, double scale, const int (&at)[4]) {
  const Vec3<double> p = scale * x.point[at[0]];
  const Vec3<double> a = scale * x.point[at[1]] - p, b = scale * x.point[at[2]] - p, c = scale * x.point[at[3]] - p;
  const double yz = b.y * c.z, zy = b.z * c.y, zx = b.z * c.x, xz = b.x * c.z, xy = b.x * c.y, yx = b.y * c.x;
  const double value = (a.x * (yz - zy) + a.y * (zx - xz)) + a.z * (xy - yx);
  // Roundings: three of the differences, one each of the products and of their difference, one of the product with a,
  // two of the sums. The permanent is computed with errors of its own, so twice that.
  const auto sum_of = [](double s, double t) { return magnitude(s) + magnitude(t); };
  const double permanent =
      (magnitude(a.x) * sum_of(yz, zy) + magnitude(a.y) * sum_of(zx, xz)) + magnitude(a.z) * sum_of(xy, yx);
  double error = 16.0 * Precision<double>::unit * permanent;
  if (point_error > 0.0) {
    // Each difference is wrong by up to twice the error of a point.
    const double la = sum_of_magnitudes(a), lb = sum_of_magnitudes(b), lc = sum_of_magnitudes(c);
    error += 4.0 * (scale * point_error) * ((la * lb + lb * lc) + lc * la);
  } else if (permanent == 0.0) {
    return Sign::kZero;
  }
  return magnitude(value) > error ? sign_of(value) : Sign::kOpen;
}

}  // namespace crossing_detail

// kPasses: the edge passes through the interior of the face, from one side to the other. If they have a common point
// otherwise, a vertex-face or edge-edge distance of the two is zero. kOpen only if not `exactly`.
enum class Crossing { kMisses, kPasses, kOpen };

// `fine()`: the points without error, or one far below that of the given ones, `point_error`.
template <class Fine>
PGCCD_HD Crossing passes_through(const EdgeAndFace<double>& given, double point_error, const Fine& fine, bool exactly) {
  using namespace crossing_detail;
  const double size = size_of(given);
  if (!(size > 0.0) && !(point_error > 0.0)) return Crossing::kMisses;
  const double scale = scale_of(size);
  EdgeAndFace<DoubleDouble> points;  // once they are needed
  bool has_points = false;
  const auto sign = [&](int p, int q, int s, int t) {
    const int at[4] = {p, q, s, t};
    const Sign found = certain_sign(given, point_error, scale, at);
    if (!(found == Sign::kOpen && exactly)) return found;
    if (!has_points) points = fine();
    has_points = true;
    return sign_of(exact_volume_of(points, scale, at));
  };
  const Sign start = sign(0, 2, 3, 4);
  if (start == Sign::kZero) return Crossing::kMisses;
  const Sign end = sign(1, 2, 3, 4);
  if (end == Sign::kZero || (end == start && end != Sign::kOpen)) return Crossing::kMisses;
  bool is_open = start == Sign::kOpen || end == Sign::kOpen;
  Sign turn = Sign::kOpen;  // of the edge about the face's edges
  for (int k = 2; k < 5; ++k) {
    const Sign own = sign(0, 1, k, k == 4 ? 2 : k + 1);
    if (own == Sign::kZero) return Crossing::kMisses;
    is_open |= own == Sign::kOpen;
    if (own == Sign::kOpen) continue;
    if (turn != Sign::kOpen && own != turn) return Crossing::kMisses;
    turn = own;
  }
  return is_open ? Crossing::kOpen : Crossing::kPasses;
}

// The point of the face on an edge that passes through it: c0 + u (c1 - c0) + v (c2 - c0) for its corners. By exact
// volumes: where edge and face are nearly coplanar, rounded ones give a point far from the edge.
struct FacePoint {
  double u, v;
};
PGCCD_HD FacePoint crossing_point(const EdgeAndFace<DoubleDouble>& x, double size) {
  const double scale = crossing_detail::scale_of(size);
  double weight[3];  // of each corner: the volume of the edge and the opposite edge of the face
  for (int k = 0; k < 3; ++k) {
    const int at[4] = {0, 1, k == 2 ? 2 : k + 3, k == 0 ? 4 : k + 1};
    weight[k] = magnitude(crossing_detail::exact_volume_of(x, scale, at));
  }
  const double sum = (weight[0] + weight[1]) + weight[2];
  return {weight[1] / sum, weight[2] / sum};
}

}  // namespace pgccd
