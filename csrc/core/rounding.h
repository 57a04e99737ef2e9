// Forward error bounds shared by the stages.
#pragma once

#include <cfloat>
#include <cmath>
#include <type_traits>

#include "core/double_double.h"

namespace pgccd {

// `unit`: relative rounding error of one operation. `smallest_square`: sums of squares above it have that accuracy,
// since terms that underflow are far below one rounding.
template <class T>
struct Precision;
template <>
struct Precision<double> {
  static constexpr double unit = 0x1p-53;
  static constexpr double smallest_square = 0x1p-900;
};
template <>
struct Precision<float> {
  static constexpr float unit = 0x1p-24f;
  static constexpr float smallest_square = 0x1p-100f;
};
template <>
struct Precision<DoubleDouble> {
  static constexpr double unit = 0x1p-101;
  static constexpr double smallest_square = 0x1p-900;
};

// Error bound of computed offsets of mesh points from their body's origin, in units of the mesh's reach: rotation
// matrix of a quaternion (8 units an entry), one product (5), axis (3), two cross products and the Rodrigues sum (at
// most 60, versine <= 2), sine and versine (4 each), and a rotation vector computed from two orientations (16). Another
// 36 cover arcs whose radius is computed 18 units too small: they deviate from their chords by at most twice their
// radius.
constexpr double kRigidPointUnits = 256.0;

// Largest power of two not above 1 / x, for x > 0; scaling by it is exact.
PGCCD_HD double inverse_power_of_two(double x) {
  int exponent = 0;
  std::frexp(x, &exponent);
  return std::ldexp(1.0, -exponent);
}

// a + b rounded towards minus infinity (the error of a sum is itself a double: Knuth 1969, TwoSum).
template <class T>
PGCCD_HD T add_down(T a, T b) {
  const T sum = a + b;
  const T b_part = sum - a;
  const T error = (a - (sum - b_part)) + (b - b_part);
  return error < T(0) ? std::nextafter(sum, -static_cast<T>(INFINITY)) : sum;
}
PGCCD_HD DoubleDouble add_down(DoubleDouble a, DoubleDouble b) {
  const DoubleDouble sum = a + b;
  return sum - magnitude(sum) * DoubleDouble(4.0 * Precision<DoubleDouble>::unit);
}

PGCCD_HD double add_up(double a, double b) { return -add_down(-a, -b); }

// x rounded down or up to another type; x itself for a type of higher precision.
template <class To>
PGCCD_HD To round_down(double x) {
  if constexpr (!std::is_same_v<To, float>) return To(x);
  const float nearest = static_cast<float>(x);
  return static_cast<double>(nearest) > x ? std::nextafter(nearest, -static_cast<float>(INFINITY)) : nearest;
}
template <class To>
PGCCD_HD To round_up(double x) {
  return -round_down<To>(-x);
}
template <class To>
PGCCD_HD To round_down(DoubleDouble x) {
  return round_down<To>(x.low < 0.0 ? std::nextafter(x.high, -static_cast<double>(INFINITY)) : x.high);
}

}  // namespace pgccd
