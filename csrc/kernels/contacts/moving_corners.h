// Corners of triangles on their paths, along a direction.
#pragma once

#include "kernels/contacts/site_item.h"

namespace pgccd {
namespace contacts_detail {

// Corners of a triangle, or of a part of it, on their paths: constant + first t; of a body that turns constant + first
// cos(angle t) + second sin(angle t).
struct MovingCorners {
  Vec3<double> constant[3], first[3], second[3];

  // Bound of all terms, and of their errors relative to one rounding, along any direction of unit length.
  PGCCD_HD double size(double angle) const {
    double largest = 0.0;
    for (int k = 0; k < 3; ++k) {
      largest = larger(
          sum_of_magnitudes(constant[k]) + (1.0 + angle) * (sum_of_magnitudes(first[k]) + sum_of_magnitudes(second[k])),
          largest);
    }
    return largest;
  }
};

// The same along a direction.
struct CornersAlong {
  double angle;
  double constant[3], first[3], second[3];
  double radius[3];  // of the circle

  PGCCD_HD static CornersAlong of(const MovingCorners& corners, double angle, Vec3<double> direction) {
    CornersAlong along;
    along.angle = angle;
    for (int k = 0; k < 3; ++k) {
      along.constant[k] = dot_of(direction, corners.constant[k]);
      along.first[k] = dot_of(direction, corners.first[k]);
      along.second[k] = along.radius[k] = 0.0;
      if (!(angle > 0.0)) continue;
      along.second[k] = dot_of(direction, corners.second[k]);
      along.radius[k] = std::sqrt(along.first[k] * along.first[k] + along.second[k] * along.second[k]);
    }
    return along;
  }
};

// The corners of one body at a time.
struct CornersAt {
  double turning[3], value[3];

  PGCCD_HD static CornersAt of(const CornersAlong& along, SineCosine turned, double time) {
    CornersAt now;
    for (int k = 0; k < 3; ++k) {
      now.turning[k] = along.first[k] * turned.cosine + along.second[k] * turned.sine;
      now.value[k] = along.constant[k] + (along.angle > 0.0 ? now.turning[k] : along.first[k] * time);
    }
    return now;
  }

  PGCCD_HD double lowest() const { return smaller(smaller(value[0], value[1]), value[2]); }
  PGCCD_HD double highest() const { return larger(larger(value[0], value[1]), value[2]); }
};

// The corners of one body in a window between two times: derivatives at the first one, and bounds of second
// derivatives.
struct CornersWithin {
  double rate[3], low[3], high[3];

  PGCCD_HD static CornersWithin of(const CornersAlong& along, SineCosine turned, const CornersAt& first,
                                   const CornersAt& last, double length) {
    CornersWithin within;
    const double angle = along.angle, square = angle * angle;
    for (int k = 0; k < 3; ++k) {
      const double cosine = along.first[k], sine = along.second[k], radius = along.radius[k];
      within.rate[k] = angle > 0.0 ? angle * (sine * turned.cosine - cosine * turned.sine) : cosine;
      const double stray = square * radius * length * length / 8.0;
      const double least = smaller(first.turning[k], last.turning[k]) - stray;
      const double most = larger(first.turning[k], last.turning[k]) + stray;
      within.low[k] = -square * smaller(most, radius);
      within.high[k] = -square * larger(least, -radius);
    }
    return within;
  }

  PGCCD_HD double lowest() const { return smaller(smaller(low[0], low[1]), low[2]); }
  PGCCD_HD double highest() const { return larger(larger(high[0], high[1]), high[2]); }
};

}  // namespace contacts_detail
}  // namespace pgccd
