// Clears many turns of a spinning body at once. A fast spinning body is replaced by all positions that it takes in a
// full turn: along a direction n, a point reaches as far as the centre of its circle plus |n x axis| times its radius.
// Only the straight motion of the centre then depends on time.
#pragma once

#include "kernels/narrow/paths.h"

namespace pgccd {

namespace whole_turns_detail {

// Remaining rotation, in radians, from which a body counts as spinning fast: chords would need many windows.
constexpr double kFastSpin = 4.0;

template <FeatureKind kKind, class T>
class SpunPair {
 public:
  PGCCD_HD SpunPair(const ArcPath<kKind, T>& path, T t) : path_(path), t_(t) {
    for (int side = 0; side < 2; ++side) spins_[side] = path.angle(side) * static_cast<double>(T(1) - t) > kFastSpin;
  }

  PGCCD_HD bool any() const { return spins_[0] || spins_[1]; }
  PGCCD_HD bool spins(int k) const { return spins_[path_.side_of(k)]; }

  // The features at t, with points of spinning bodies replaced by the centres of their circles, or (`height` 0) of the
  // body.
  PGCCD_HD FeaturePair<T> hubs(T height) const {
    Vec3<T> x[4];
    path_.positions(t_, x);
    for (int k = 0; k < 4; ++k) {
      if (!spins(k)) continue;
      x[k] = height * hub(k);
      if (path_.side_of(k) == 1) x[k] = path_.shift_at(t_) + x[k];
    }
    return feature_pair<kKind>(x[0], x[1], x[2], x[3]);
  }

  // A time until which the features stay apart along `n`; the gap is the smallest projection of the second feature
  // minus the largest of the first. Projections of spinning bodies are constant except for the motion of the centres,
  // others are those of chords minus their deviation.
  PGCCD_HD T free_until(Vec3<T> n, T separation) const {
    constexpr T u(Precision<T>::unit);
    T bend(0);  // |x''| of the bodies that do not spin fast
    for (int side = 0; side < 2; ++side) {
      if (!spins_[side]) bend = bend + curvature(side);
    }
    const PairError<T> error = path_.error();
    const T threshold = separation * (T(1) + T(16) * u) + (T(2) * error.point + T(32) * u * error.extent);
    const T start = gap(t_, n);
    T window = T(1) - t_;
    if (bend * window * window > T(2) * (start - threshold)) window = square_root(T(2) * (start - threshold) / bend);
    const T end = t_ + window < T(1) ? t_ + window : T(1);
    const T duration = end - t_, kept = threshold + bend * duration * duration * T(0.125) * (T(1) + T(16) * u);
    if (!(start > kept)) return t_;
    const T prefix = certificate_detail::prefix_of_line(start, gap(end, n), kept);
    return prefix >= T(1) ? end : add_down(t_, prefix * duration * (T(1) - T(4) * u));
  }

 private:
  // Centre of the point's circle on the axis, relative to the body's origin.
  PGCCD_HD Vec3<T> hub(int k) const { return path_.point(k).base + path_.point(k).inward; }

  PGCCD_HD T gap(T t, Vec3<T> n) const {
    Vec3<T> x[4];
    path_.positions(t, x);
    T high(-INFINITY), low(INFINITY);
    for (int k = 0; k < 4; ++k) {
      const int side = path_.side_of(k);
      T projection = dot(n, x[k]), reach(0);
      if (spins_[side]) {
        projection = dot(n, side == 0 ? hub(k) : path_.shift_at(t) + hub(k));
        const T along_quarter = dot(n, path_.point(k).quarter), along_inward = dot(n, path_.point(k).inward);
        reach = square_root(along_quarter * along_quarter + along_inward * along_inward);
      }
      if (side == 0) {
        high = larger(projection + reach, high);
      } else {
        low = smaller(projection - reach, low);
      }
    }
    return low - high;
  }

  PGCCD_HD T curvature(int side) const {
    T radius(0);
    for (int k = 0; k < 4; ++k) {
      if (path_.side_of(k) == side) radius = larger(radius, norm(path_.point(k).quarter));
    }
    return T(1.0 + 0x1p-40) * (path_.angle(side) * path_.angle(side) * radius);
  }

  const ArcPath<kKind, T>& path_;
  T t_;
  bool spins_[2];
};

}  // namespace whole_turns_detail

// A time until which the features stay apart, or `t` itself if nothing is gained. Directions: the given one; those
// between the nearest points with spinning features shrunk to the centres of their circles, or to the centre of the
// body; and the axes.
template <FeatureKind kKind, class T>
PGCCD_HD T free_while_spinning(const ArcPath<kKind, T>& path, T t, Vec3<T> direction, T separation) {
  const whole_turns_detail::SpunPair<kKind, T> pair(path, t);
  if (!pair.any()) return t;
  const Vec3<T> between_circles = direction_of(nearest_points<kKind>(pair.hubs(T(1))));
  T until = larger(t, pair.free_until(direction, separation));
  until = larger(until, pair.free_until(between_circles, separation));
  const Vec3<T> from_centre = direction_of(nearest_points<kKind>(pair.hubs(T(0))));
  until = larger(until, pair.free_until(from_centre, separation));
  for (int k = 0; k < 4; ++k) {
    if (!pair.spins(k)) continue;
    const Vec3<T> axis = unit_vector(cross(path.point(k).quarter, path.point(k).inward));
    until = larger(until, pair.free_until(dot(axis, between_circles) < T(0) ? -axis : axis, separation));
  }
  return until;
}

// Straight paths do not rotate.
template <FeatureKind kKind, class T>
PGCCD_HD T free_while_spinning(const LinearPath<kKind, T>&, T t, Vec3<T> /*direction*/, T /*separation*/) {
  return t;
}

}  // namespace pgccd
