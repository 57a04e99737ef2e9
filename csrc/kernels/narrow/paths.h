// Paths of the four points of a feature pair through the step: the pair at any time, and a bound of the points'
// deviation from the chord between two times.
#pragma once

#include "core/bodies.h"
#include "kernels/narrow/certificates.h"

namespace pgccd {

// Number of the points x0 .. x3 that belong to the first primitive: the vertex, or the first edge's two.
template <FeatureKind kKind>
struct PointSplit {
  static constexpr int first_count = kIsEdgeEdge<kKind> ? 2 : 1;
};

// Straight vertex paths: differences of linear functions are linear, so the differences themselves are interpolated.
template <FeatureKind kKind, class T>
class LinearPath {
 public:
  // Proofs of contact and higher precision apply only to straight paths.
  static constexpr bool kStraight = true;

  // `point_error`: error bound of the given points (0 if they are exact).
  PGCCD_HD LinearPath(const Vec3<T> t0[4], const Vec3<T> t1[4], T point_error)
      : t0_(feature_pair<kKind>(t0[0], t0[1], t0[2], t0[3])), t1_(feature_pair<kKind>(t1[0], t1[1], t1[2], t1[3])) {
    const T size = larger(extent(t0_), extent(t1_));
    // Scaled to about unit size, by a power of two: exact, and products of six lengths neither overflow nor underflow.
    scale_ = size > T(0) ? static_cast<T>(inverse_power_of_two(static_cast<double>(size))) : T(1);
    t0_ = {scale_ * t0_.r, scale_ * t0_.a, scale_ * t0_.b};
    t1_ = {scale_ * t1_.r, scale_ * t1_.a, scale_ * t1_.b};
    error_ = {scale_ * point_error, scale_ * size};
  }

  // All lengths of the path are the given ones times this.
  PGCCD_HD T scale() const { return scale_; }

  PGCCD_HD FeaturePair<T> at(T t) const {
    const T s = T(1) - t;
    return {s * t0_.r + t * t1_.r, s * t0_.a + t * t1_.a, s * t0_.b + t * t1_.b};
  }
  PGCCD_HD FeaturePair<T> velocity() const { return {t1_.r - t0_.r, t1_.a - t0_.a, t1_.b - t0_.b}; }
  PGCCD_HD T window(T /*gap*/, T remaining) const { return remaining; }
  PGCCD_HD T deviation(T /*duration*/) const { return T(0); }
  PGCCD_HD PairError<T> error() const { return error_; }
  PGCCD_HD int more_advances() const { return 0; }

 private:
  FeaturePair<T> t0_, t1_;
  T scale_;
  PairError<T> error_;
};

// A mesh point that rotates about its body's origin: base + sin(angle t) quarter + versin(angle t) inward (Rodrigues).
template <class T>
struct ArcPoint {
  Vec3<T> base;
  Vec3<T> quarter;  // axis x base; its length is the distance from the axis
  Vec3<T> inward;   // axis x quarter
};

template <class T>
PGCCD_HD ArcPoint<T> arc_point(const Spin& spin, Vec3<T> base) {
  const Vec3<T> axis = cast<T>(spin.axis), quarter = cross(axis, base);
  return {base, quarter, cross(axis, quarter)};
}

template <class T>
PGCCD_HD Vec3<T> arc_position(const ArcPoint<T>& p, const SineCosine& at) {
  return p.base + (T(at.sine) * p.quarter + T(at.versine) * p.inward);
}

// Rigid arcs, relative to the origin of the first primitive's body. Angles, sines and cosines are doubles in any
// precision: they are multiplied by zero for points of bodies that do not turn.
template <FeatureKind kKind, class T>
class ArcPath {
 public:
  static constexpr bool kStraight = false;

  PGCCD_HD ArcPath(const Vec3<T> bases[4], const Spin& first, const Spin& second, const RelativeCentreIn<T>& centre,
                   T point_error)
      : first_angle_(first.angle), second_angle_(second.angle), centre_(centre) {
    T first_radius(0), second_radius(0);
    for (int k = 0; k < 4; ++k) {
      const bool is_first = k < PointSplit<kKind>::first_count;
      points_[k] = arc_point(is_first ? first : second, bases[k]);
      T& radius = is_first ? first_radius : second_radius;
      radius = larger(radius, norm(points_[k].quarter));
    }
    // |x''| <= angle^2 radius for each body; the factor covers the rounding of this expression.
    curvature_ =
        T(1.0 + 0x1p-40) * (first.angle * first.angle * first_radius + second.angle * second.angle * second_radius);
    T reach(0);
    for (int k = 0; k < 4; ++k) reach = larger(reach, T(3) * max_abs(bases[k]));
    error_ = {point_error, T(6) * (reach + larger(max_abs(centre.at_t0), max_abs(centre.at_t1)))};
  }

  PGCCD_HD T scale() const { return T(1); }
  PGCCD_HD FeaturePair<T> at(T t) const {
    Vec3<T> x[4];
    positions(t, x);
    return feature_pair<kKind>(x[0], x[1], x[2], x[3]);
  }
  // Relative to the origin at t of the first primitive's body.
  PGCCD_HD void positions(T t, Vec3<T> x[4]) const {
    const SineCosine first = sine_cosine(first_angle_ * static_cast<double>(t));
    const SineCosine second = sine_cosine(second_angle_ * static_cast<double>(t));
    const Vec3<T> shift = shift_at(t);
    for (int k = 0; k < 4; ++k) {
      const bool is_first = k < PointSplit<kKind>::first_count;
      x[k] = arc_position(points_[k], is_first ? first : second);
      if (!is_first) x[k] = shift + x[k];
    }
  }
  // A window over which the chords deviate by no more than a quarter of the gap.
  PGCCD_HD T window(T gap, T remaining) const {
    if (!(curvature_ * remaining * remaining > T(2) * gap)) return remaining;
    return square_root(T(2) * gap / curvature_);
  }
  // Linear interpolation of a curve deviates by at most max |x''| duration^2 / 8, for both bodies together.
  PGCCD_HD T deviation(T duration) const { return curvature_ * duration * duration * T(0.125); }
  PGCCD_HD PairError<T> error() const { return error_; }

  // Windows are short for fast spinning bodies.
  PGCCD_HD int more_advances() const { return static_cast<int>(smaller(2.0 * (first_angle_ + second_angle_), 0x1p20)); }

  // Body of a point: 0 for that of the first primitive, 1 for that of the second.
  PGCCD_HD static int side_of(int k) { return k < PointSplit<kKind>::first_count ? 0 : 1; }
  PGCCD_HD const ArcPoint<T>& point(int k) const { return points_[k]; }
  PGCCD_HD double angle(int side) const { return side == 0 ? first_angle_ : second_angle_; }
  // Offset of the second body's origin.
  PGCCD_HD Vec3<T> shift_at(T t) const { return (T(1) - t) * centre_.at_t0 + t * centre_.at_t1; }

 private:
  ArcPoint<T> points_[4];
  double first_angle_, second_angle_;
  T curvature_;
  RelativeCentreIn<T> centre_;
  PairError<T> error_;
};

}  // namespace pgccd
