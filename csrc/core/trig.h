// Sine, cosine and arctangent, since the C and CUDA libraries differ in the last bit, which would break equality
// between CPU and GPU. Polynomials (Taylor, coefficients exact reciprocal factorials) after a three-part Cody & Waite
// 1980 reduction. Absolute error below 2 units of 2^-53 for |angle| <= 1e6 (tested against mpmath).
#pragma once

#include <cmath>

#include "core/platform.h"

namespace pgccd {

constexpr double kLargestAngle = 1e6;

struct SineCosine {
  double sine;
  double cosine;
  double versine;  // 1 - cos, without cancellation for small angles
};

// The polynomial in x with these coefficients, that of the highest power first.
template <class... Coefficients>
PGCCD_HD double polynomial(double x, double highest, Coefficients... others) {
  double value = highest;
  ((value = others + x * value), ...);
  return value;
}

PGCCD_HD SineCosine sine_cosine(double angle) {
  constexpr double two_over_pi = 0x1.45f306dc9c883p-1;
  constexpr double half_pi_high = 0x1.921fb54442d18p+0;
  constexpr double half_pi_middle = 0x1.1a62633145c07p-54;
  constexpr double half_pi_low = -0x1.f1976b7ed8fbcp-110;
  const double quadrant = std::floor(angle * two_over_pi + 0.5);
  double r = std::fma(-quadrant, half_pi_high, angle);
  r = std::fma(-quadrant, half_pi_middle, r);
  r = std::fma(-quadrant, half_pi_low, r);
  const double q = r * r;

  const double s = polynomial(q, 1.0 / 355687428096000.0, -1.0 / 1307674368000.0, 1.0 / 6227020800.0, -1.0 / 39916800.0,
                              1.0 / 362880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0);
  const double sine = r + r * (q * s);

  const double v = polynomial(q, 1.0 / 6402373705728000.0, -1.0 / 20922789888000.0, 1.0 / 87178291200.0,
                              -1.0 / 479001600.0, 1.0 / 3628800.0, -1.0 / 40320.0, 1.0 / 720.0, -1.0 / 24.0);
  const double versine = q * 0.5 + q * (q * v);
  const double cosine = 1.0 - versine;

  switch (static_cast<int>(static_cast<long long>(quadrant) & 3)) {
    case 0:
      return {sine, cosine, versine};
    case 1:
      return {cosine, -sine, 1.0 + sine};
    case 2:
      return {-sine, -cosine, 1.0 + cosine};
    default:
      return {-cosine, sine, 1.0 - sine};
  }
}

// Angle in [0, pi/2] of the point (x, y), x >= 0, y >= 0, not both zero. An initial approximation, then two steps of
// angle += (y cos - x sin) / r, each of which cubes the error (4e-3 -> 1e-8 -> 1e-24).
PGCCD_HD double first_quadrant_angle(double y, double x) {
  constexpr double quarter_pi = 0x1.921fb54442d18p-1;
  const bool steep = y > x;
  const double z = steep ? x / y : y / x;
  double angle = z * (quarter_pi + 0.273 * (1.0 - z));
  if (steep) angle = 2.0 * quarter_pi - angle;
  const double radius = std::sqrt(x * x + y * y);
  for (int step = 0; step < 2; ++step) {
    const SineCosine at = sine_cosine(angle);
    angle += (y * at.cosine - x * at.sine) / radius;
  }
  return angle;
}

}  // namespace pgccd
