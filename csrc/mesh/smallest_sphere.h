// The smallest sphere about the points of a node.
#pragma once

#include <array>
#include <cmath>
#include <optional>
#include <utility>

#include "core/vec3.h"
#include "mesh/point_columns.h"

namespace pgccd {

struct Sphere {
  Vec3<double> centre;
  double squared_radius;
};

// Spheres through a point and one, two or three others, relative to it, centred in the plane or line that they span.
// Division by zero, where they are not independent, gives centres that are no numbers.
inline Vec3<double> centre_through(Vec3<double> a) { return 0.5 * a; }
inline Vec3<double> centre_through(Vec3<double> a, Vec3<double> b) {
  const Vec3<double> normal = cross(a, b);
  return (0.5 / dot(normal, normal)) * cross(dot(a, a) * b - dot(b, b) * a, normal);
}
inline Vec3<double> centre_through(Vec3<double> a, Vec3<double> b, Vec3<double> c) {
  const Vec3<double> of_a = cross(b, c), of_b = cross(c, a), of_c = cross(a, b);
  return (0.5 / dot(a, of_a)) * (dot(a, a) * of_a + dot(b, b) * of_b + dot(c, c) * of_c);
}

// Up to four points on the surface of a sphere that determine it.
class SphereSupport {
 public:
  explicit SphereSupport(Vec3<double> point) : points_{point}, sphere_{point, 0.0} {}

  const Sphere& sphere() const { return sphere_; }

  // Makes the sphere the smallest about the support and a point outside of it. False if rounding leaves none.
  bool include(Vec3<double> point) {
    std::array<Vec3<double>, 4> others;
    for (int k = 0; k < count_; ++k) others[k] = points_[k] - point;
    unsigned best = 0;
    Sphere smallest{{}, HUGE_VAL};
    for (unsigned chosen = 1; chosen < 1u << count_; ++chosen) {
      std::array<Vec3<double>, 4> on_surface;
      int size = 0;
      for (int k = 0; k < count_; ++k) {
        if (chosen >> k & 1) on_surface[size++] = others[k];
      }
      if (size == 4) continue;
      const Vec3<double> centre = size == 1   ? centre_through(on_surface[0])
                                  : size == 2 ? centre_through(on_surface[0], on_surface[1])
                                              : centre_through(on_surface[0], on_surface[1], on_surface[2]);
      const double squared_radius = dot(centre, centre);
      if (!(squared_radius < smallest.squared_radius)) continue;
      bool contains_all = true;
      for (int k = 0; k < count_; ++k) {
        const Vec3<double> from_centre = others[k] - centre;
        contains_all &= dot(from_centre, from_centre) <= squared_radius * (1.0 + 1e-9);
      }
      if (!contains_all) continue;
      best = chosen;
      smallest = {centre, squared_radius};
    }
    if (best == 0) return false;
    int kept = 0;
    for (int k = 0; k < count_; ++k) {
      if (best >> k & 1) points_[kept++] = points_[k];
    }
    points_[kept] = point;
    count_ = kept + 1;
    sphere_ = {point + smallest.centre, smallest.squared_radius};
    return true;
  }

 private:
  std::array<Vec3<double>, 4> points_;
  int count_ = 1;
  Sphere sphere_;
};

// Centre of the smallest sphere about the points, to about a thousandth of its radius: includes the point farthest
// from the centre until all are inside (Gaertner 1999).
inline Vec3<double> centre_of_smallest_sphere(const PointColumns& points) {
  constexpr int kMostPoints = 32;
  constexpr double kInside = 1.001 * 1.001;  // of the squared radius
  SphereSupport support(points.farthest(points.point(0)).second);
  for (int k = 0; k < kMostPoints; ++k) {
    const auto [squared_distance, farthest] = points.farthest(support.sphere().centre);
    if (squared_distance <= kInside * support.sphere().squared_radius) break;
    if (!support.include(farthest)) break;
  }
  return support.sphere().centre;
}

}  // namespace pgccd
