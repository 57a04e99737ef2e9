// Whether an edge passes through a face, by the exact signs of five determinants of the given points.
#pragma once

#include "core/exact_volume.h"
#include "core/rounding.h"

namespace pgccd {

// The end points of an edge, and the corners of a face.
struct EdgeAndFace {
  Vec3<double> edge[2], face[3];
};

namespace crossing_detail {

enum class Sign : int32_t { kNegative = -1, kZero = 0, kPositive = 1, kOpen = 2 };

// Of (q - p) . ((s - p) x (t - p)); kOpen only if not `exactly`.
PGCCD_HD Sign volume_sign(Vec3<double> p, Vec3<double> q, Vec3<double> s, Vec3<double> t, bool exactly) {
  const auto sign_of = [](double x) { return x > 0.0 ? Sign::kPositive : (x < 0.0 ? Sign::kNegative : Sign::kZero); };
  const Vec3<double> a = q - p, b = s - p, c = t - p;
  const double yz = b.y * c.z, zy = b.z * c.y, zx = b.z * c.x, xz = b.x * c.z, xy = b.x * c.y, yx = b.y * c.x;
  const double value = (a.x * (yz - zy) + a.y * (zx - xz)) + a.z * (xy - yx);
  // Roundings: three of the differences, one each of the products and of their difference, one of the product with a,
  // two of the sums. The permanent is computed with errors of its own, so twice that.
  const auto sum_of = [](double x, double y) { return magnitude(x) + magnitude(y); };
  const double permanent =
      (magnitude(a.x) * sum_of(yz, zy) + magnitude(a.y) * sum_of(zx, xz)) + magnitude(a.z) * sum_of(xy, yx);
  const double error = 16.0 * Precision<double>::unit * permanent;
  if (magnitude(value) > error) return sign_of(value);
  if (permanent == 0.0) return Sign::kZero;
  return exactly ? sign_of(exact_volume(p, q, s, t)) : Sign::kOpen;
}

// The largest coordinate of a difference to the first point.
PGCCD_HD double size_of(const EdgeAndFace& x) {
  double size = max_abs(x.edge[1] - x.edge[0]);
  for (int k = 0; k < 3; ++k) size = larger(size, max_abs(x.face[k] - x.edge[0]));
  return size;
}

// Scaled to about unit size, by a power of two: exact, and products neither overflow nor, unless a distance is below
// 2^-450 of the size, underflow.
PGCCD_HD EdgeAndFace scaled(const EdgeAndFace& x, double size) {
  const double scale = inverse_power_of_two(larger(size, 0x1p-1000));
  return {{scale * x.edge[0], scale * x.edge[1]}, {scale * x.face[0], scale * x.face[1], scale * x.face[2]}};
}

}  // namespace crossing_detail

// kPasses: the edge passes through the interior of the face, from one side to the other. If they have a common point
// otherwise, a vertex-face or edge-edge distance of the two is zero. kOpen only if not `exactly`.
enum class Crossing { kMisses, kPasses, kOpen };
PGCCD_HD Crossing passes_through(const EdgeAndFace& given, bool exactly) {
  using crossing_detail::Sign;
  using crossing_detail::volume_sign;
  const double size = crossing_detail::size_of(given);
  if (!(size > 0.0)) return Crossing::kMisses;
  const EdgeAndFace x = crossing_detail::scaled(given, size);
  const Sign start = volume_sign(x.edge[0], x.face[0], x.face[1], x.face[2], exactly);
  if (start == Sign::kZero) return Crossing::kMisses;
  const Sign end = volume_sign(x.edge[1], x.face[0], x.face[1], x.face[2], exactly);
  if (end == Sign::kZero || (end == start && end != Sign::kOpen)) return Crossing::kMisses;
  bool is_open = start == Sign::kOpen || end == Sign::kOpen;
  Sign turn = Sign::kOpen;  // of the edge about the face's edges
  for (int k = 0; k < 3; ++k) {
    const Sign own = volume_sign(x.edge[0], x.edge[1], x.face[k], x.face[k == 2 ? 0 : k + 1], exactly);
    if (own == Sign::kZero) return Crossing::kMisses;
    is_open |= own == Sign::kOpen;
    if (own == Sign::kOpen) continue;
    if (turn != Sign::kOpen && own != turn) return Crossing::kMisses;
    turn = own;
  }
  return is_open ? Crossing::kOpen : Crossing::kPasses;
}

// The point of the face on an edge that passes through it: face[0] + u (face[1] - face[0]) + v (face[2] - face[0]). By
// exact volumes: where edge and face are nearly coplanar, rounded ones give a point far from the edge.
struct FacePoint {
  double u, v;
};
PGCCD_HD_RARE inline FacePoint crossing_point(const EdgeAndFace& given) {
  const EdgeAndFace x = crossing_detail::scaled(given, crossing_detail::size_of(given));
  double weight[3];  // of each corner: the volume of the edge and the opposite edge of the face
  for (int k = 0; k < 3; ++k) {
    const int next = k == 2 ? 0 : k + 1, last = k == 0 ? 2 : k - 1;
    weight[k] = magnitude(exact_volume(x.edge[0], x.edge[1], x.face[next], x.face[last]));
  }
  const double sum = (weight[0] + weight[1]) + weight[2];
  return {weight[1] / sum, weight[2] / sum};
}

}  // namespace pgccd
