// Signed volumes of tetrahedra with exact signs: sums of products of doubles as expansions (Shewchuk 1997, doi
// 10.1007/PL00009321). Only IEEE operations and fma, so the same bits on every backend.
#pragma once

#include <initializer_list>

#include "core/double_double.h"
#include "core/vec3.h"

namespace pgccd {

// A sum of doubles without rounding, as components of ascending magnitude that do not overlap.
class ExactSum {
 public:
  PGCCD_HD void add(double x) {
    if (!(x - x == 0.0)) return;  // not finite, of invalid points: components would not stay bounded in number
    int kept = 0;
    for (int k = 0; k < count_; ++k) {
      const DoubleDouble s = double_double_detail::two_sum(x, part_[k]);
      if (s.low != 0.0) part_[kept++] = s.low;
      x = s.high;
    }
    if (x != 0.0) part_[kept++] = x;
    count_ = kept;
    if (count_ == kMostParts) compress();
  }

  // The sum to within a unit in the last place, so with its sign.
  PGCCD_HD double rounded() {
    if (count_ == 0) return 0.0;
    compress();
    return part_[count_ - 1];
  }

 private:
  // Each component of a compressed sum is at most an ulp of the next: they span 52 bits each, so that sums between
  // 2^-1074 and 2^6 have at most 22.
  static constexpr int kMostParts = 32;

  // Algorithm COMPRESS.
  PGCCD_HD void compress() {
    using double_double_detail::ordered_two_sum;
    double sum = part_[count_ - 1];
    int bottom = count_ - 1;
    for (int k = count_ - 2; k >= 0; --k) {
      const DoubleDouble s = ordered_two_sum(sum, part_[k]);
      sum = s.high;
      if (s.low == 0.0) continue;
      part_[bottom--] = sum;
      sum = s.low;
    }
    part_[bottom] = sum;
    int top = 0;
    for (int k = bottom + 1; k < count_; ++k) {
      const DoubleDouble s = ordered_two_sum(part_[k], sum);
      sum = s.high;
      if (s.low != 0.0) part_[top++] = s.low;
    }
    part_[top++] = sum;
    count_ = top;
  }

  double part_[kMostParts];
  int count_ = 0;
};

namespace exact_volume_detail {

// Three numbers as exact sums of four doubles.
struct ExactVec3 {
  double part[3][4];
};

PGCCD_HD ExactVec3 difference(const Vec3<DoubleDouble>& to, const Vec3<DoubleDouble>& from) {
  using double_double_detail::two_sum;
  const DoubleDouble a[3] = {to.x, to.y, to.z}, b[3] = {from.x, from.y, from.z};
  ExactVec3 out;
  for (int k = 0; k < 3; ++k) {
    const DoubleDouble high = two_sum(a[k].high, -b[k].high), low = two_sum(a[k].low, -b[k].low);
    const double part[4] = {high.high, high.low, low.high, low.low};
    for (int m = 0; m < 4; ++m) out.part[k][m] = part[m];
  }
  return out;
}

PGCCD_HD void add_product(ExactSum& sum, double x, double y, double z) {
  using double_double_detail::two_product;
  if (x == 0.0 || y == 0.0 || z == 0.0) return;
  const DoubleDouble xy = two_product(x, y), high = two_product(xy.high, z), low = two_product(xy.low, z);
  for (const double part : {low.low, low.high, high.low, high.high}) {
    if (part != 0.0) sum.add(part);
  }
}

}  // namespace exact_volume_detail

// (q - p) . ((s - p) x (t - p)) to within a unit in the last place: the sign is exact. For points of about unit size:
// products below 2^-1022 are rounded.
PGCCD_HD_RARE inline double exact_volume(const Vec3<DoubleDouble>& p, const Vec3<DoubleDouble>& q,
                                         const Vec3<DoubleDouble>& s, const Vec3<DoubleDouble>& t) {
  using namespace exact_volume_detail;
  const ExactVec3 a = difference(q, p), b = difference(s, p), c = difference(t, p);
  ExactSum sum;
  PGCCD_KEEP_LOOP
  for (int k = 0; k < 3; ++k) {
    const int l = k == 2 ? 0 : k + 1, m = k == 0 ? 2 : k - 1;
    PGCCD_KEEP_LOOP
    for (int i = 0; i < 4; ++i) {
      const double x = a.part[k][i];
      if (x == 0.0) continue;  // most low parts are
      PGCCD_KEEP_LOOP
      for (int j = 0; j < 4; ++j) {
        PGCCD_KEEP_LOOP
        for (int n = 0; n < 4; ++n) {
          add_product(sum, x, b.part[l][j], c.part[m][n]);
          add_product(sum, -x, b.part[m][j], c.part[l][n]);
        }
      }
    }
  }
  return sum.rounded();
}

}  // namespace pgccd
