// Numbers of 106 significant bits as unevaluated sums of two doubles (Dekker 1971). Barring underflow, a sum is correct
// to within 3 u^2, a product 5 u^2, a quotient 15 u^2 (Joldes, Muller, Popescu 2017, doi 10.1145/3121432, algorithms 6,
// 12 and 17), a root 25/8 u^2 (Lefevre et al. 2023, doi 10.1145/3568672), u = 2^-53; Precision<DoubleDouble>::unit, 32
// u^2, bounds them all. Only IEEE operations and fma, so the same bits on every backend.
#pragma once

#include <cmath>

#include "core/scalar.h"

namespace pgccd {

struct DoubleDouble {
  double high, low;  // high is the rounded sum

  DoubleDouble() = default;
  PGCCD_HD constexpr DoubleDouble(double x) : high(x), low(0.0) {}
  PGCCD_HD constexpr DoubleDouble(double h, double l) : high(h), low(l) {}
  PGCCD_HD explicit operator double() const { return high; }
  PGCCD_HD explicit operator float() const { return static_cast<float>(high); }
};

namespace double_double_detail {

// Exact: a + b = high + low.
PGCCD_HD DoubleDouble two_sum(double a, double b) {
  const double sum = a + b;
  const double b_part = sum - a;
  return {sum, (a - (sum - b_part)) + (b - b_part)};
}
// As two_sum, for |a| >= |b|.
PGCCD_HD DoubleDouble ordered_two_sum(double a, double b) {
  const double sum = a + b;
  return {sum, b - (sum - a)};
}
PGCCD_HD DoubleDouble two_product(double a, double b) {
  const double product = a * b;
  return {product, std::fma(a, b, -product)};
}

}  // namespace double_double_detail

PGCCD_HD DoubleDouble operator-(DoubleDouble a) { return {-a.high, -a.low}; }

PGCCD_HD DoubleDouble operator+(DoubleDouble a, DoubleDouble b) {
  using namespace double_double_detail;
  const DoubleDouble s = two_sum(a.high, b.high);
  const DoubleDouble t = two_sum(a.low, b.low);
  const DoubleDouble v = ordered_two_sum(s.high, s.low + t.high);
  return ordered_two_sum(v.high, t.low + v.low);
}
PGCCD_HD DoubleDouble operator-(DoubleDouble a, DoubleDouble b) { return a + -b; }

PGCCD_HD DoubleDouble operator*(DoubleDouble a, DoubleDouble b) {
  using namespace double_double_detail;
  const DoubleDouble c = two_product(a.high, b.high);
  const double cross = std::fma(a.low, b.high, std::fma(a.high, b.low, a.low * b.low));
  return ordered_two_sum(c.high, c.low + cross);
}

PGCCD_HD DoubleDouble operator/(DoubleDouble a, DoubleDouble b) {
  using namespace double_double_detail;
  const double estimate = a.high / b.high;
  const DoubleDouble back = b * DoubleDouble(estimate);
  const double rest = (a.high - back.high) + (a.low - back.low);
  return ordered_two_sum(estimate, rest / b.high);
}

PGCCD_HD DoubleDouble multiply_add(DoubleDouble a, DoubleDouble b, DoubleDouble c) { return a * b + c; }

PGCCD_HD bool operator<(DoubleDouble a, DoubleDouble b) {
  return a.high < b.high || (a.high == b.high && a.low < b.low);
}
PGCCD_HD bool operator>(DoubleDouble a, DoubleDouble b) { return b < a; }
PGCCD_HD bool operator==(DoubleDouble a, DoubleDouble b) { return a.high == b.high && a.low == b.low; }
PGCCD_HD bool operator>=(DoubleDouble a, DoubleDouble b) { return b < a || a == b; }

PGCCD_HD DoubleDouble magnitude(DoubleDouble x) { return x.high < 0.0 ? -x : x; }

PGCCD_HD DoubleDouble square_root(DoubleDouble x) {
  using namespace double_double_detail;
  if (!(x.high > 0.0)) return std::sqrt(x.high);  // 0, or NaN
  const double root = std::sqrt(x.high);
  const double rest = std::fma(-root, root, x.high) + x.low;
  return ordered_two_sum(root, rest / (2.0 * root));
}

}  // namespace pgccd
