// Segments of paths: joint values as polynomials of time. docs/explanation/exactness.md, section 14, has the proof.
#pragma once

#include "core/vec3.h"
#include "kernels/arms/arm.h"

namespace pgccd {

// The values of all coordinates over a segment, from its time 0 to 1, by control points of Bernstein polynomials.
// Degree 1: constant rates.
struct JointCurve {
  const double* control;  // (degree + 1, coordinates)
  int64_t coordinate_count;
  int32_t degree;
  double error;  // of the control points: the true values are within this of these curves

  PGCCD_HD double point(int32_t coordinate, int32_t k) const { return control[k * coordinate_count + coordinate]; }
  PGCCD_HD double step(int32_t coordinate, int32_t k) const { return point(coordinate, k + 1) - point(coordinate, k); }

  // Equal bits at the end of a segment and at the begin of the next one.
  PGCCD_HD double value(int32_t coordinate, double s) const {
    if (degree == 1) {
      const double from = point(coordinate, 0), to = point(coordinate, 1);
      return s == 1.0 ? to : from + s * (to - from);
    }
    // Terms of the Bernstein basis are never negative, so nothing cancels: in the manner of Horner, with power = s^k
    // and binomial = (degree over k), which is an integer and exact.
    const double rest = 1.0 - s;
    double power = 1.0, binomial = 1.0, sum = point(coordinate, 0) * rest;
    for (int32_t k = 1; k < degree; ++k) {
      power *= s;
      binomial = binomial * (degree - k + 1) / k;
      sum = (sum + (power * binomial) * point(coordinate, k)) * rest;
    }
    return sum + (power * s) * point(coordinate, degree);
  }

  // The magnitude of a coordinate, at most.
  PGCCD_HD double largest(int32_t coordinate) const {
    double most = 0.0;
    for (int32_t k = 0; k <= degree; ++k) most = larger(most, magnitude(point(coordinate, k)));
    return most;
  }

  // The magnitude of the first derivative, at most.
  PGCCD_HD double rate(int32_t coordinate) const {
    double most = 0.0;
    for (int32_t k = 0; k < degree; ++k) most = larger(most, magnitude(step(coordinate, k)));
    return degree * most;
  }

  // How far a coordinate is, between two times, from where constant rates between its computed values lead, at most.
  PGCCD_HD double deviation(int32_t coordinate, double begin, double end) const {
    if (degree == 1) return error;
    double most = 0.0;  // of the second differences
    for (int32_t k = 0; k + 1 < degree; ++k) {
      most = larger(most, magnitude(step(coordinate, k + 1) - step(coordinate, k)));
    }
    const double second_derivative = degree * (degree - 1) * most;
    const double length = end - begin;
    return 0.125 * (length * length) * second_derivative + kCurveError * (degree * degree * largest(coordinate)) +
           error;
  }

  // Rounding of values and of second differences, in units of the square of the degree and the largest value.
  static constexpr double kCurveError = 0x1p-50;
};

// Higher degrees are not read.
constexpr int32_t kMostDegree = 16;

PGCCD_HD JointCurve curve_of(const ArmPaths& paths, const Arm& arm, int64_t path, int64_t segment) {
  const int64_t row = path * paths.control_count + segment * paths.degree;
  return {paths.control + row * arm.coordinate_count, arm.coordinate_count, paths.degree, paths.error};
}

}  // namespace pgccd
