// Minimum, maximum, clamp, magnitude and root with one name for every number type; a single instruction for built-in
// types, the same on every backend. A NaN in the first argument of a comparison yields the second.
#pragma once

#include <cmath>

#include "core/platform.h"

namespace pgccd {

template <class T>
PGCCD_HD T larger(T a, T b) {
  return a > b ? a : b;
}
template <class T>
PGCCD_HD T smaller(T a, T b) {
  return a < b ? a : b;
}
// Clamps to [0, 1]; NaN becomes 0.
template <class T>
PGCCD_HD T unit_clamp(T x) {
  return smaller(larger(x, T(0)), T(1));
}

PGCCD_HD float magnitude(float x) { return std::fabs(x); }
PGCCD_HD double magnitude(double x) { return std::fabs(x); }
// a b + c, with a single rounding for built-in types.
PGCCD_HD float multiply_add(float a, float b, float c) { return std::fma(a, b, c); }
PGCCD_HD double multiply_add(double a, double b, double c) { return std::fma(a, b, c); }
PGCCD_HD float square_root(float x) { return std::sqrt(x); }
PGCCD_HD double square_root(double x) { return std::sqrt(x); }

}  // namespace pgccd
