// The points of a node in columns, so that vector units process four at a time.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "core/vec3.h"

namespace pgccd {

// Four numbers at a time; the first three lanes hold coordinates. g++ and clang++ support these types.
using Double4 = double __attribute__((vector_size(32)));
using Mask4 = int64_t __attribute__((vector_size(32)));
constexpr int64_t kDoubleLanes = 4;

inline Double4 multiply_add(Double4 a, Double4 b, Double4 c) {
  for (int lane = 0; lane < kDoubleLanes; ++lane) c[lane] = std::fma(a[lane], b[lane], c[lane]);
  return c;
}

// Points of one node, in columns padded to whole lanes with copies of the first.
class PointColumns {
 public:
  void load(const double* vertices, const std::vector<int32_t>& rows) {
    count_ = (static_cast<int64_t>(rows.size()) + kDoubleLanes - 1) / kDoubleLanes;
    for (std::vector<Double4>& column : columns_) column.resize(static_cast<size_t>(count_));
    for (int64_t k = 0; k < count_ * kDoubleLanes; ++k) {
      const size_t row = k < static_cast<int64_t>(rows.size()) ? static_cast<size_t>(k) : 0;
      const double* const point = vertices + 3 * int64_t{rows[row]};
      for (int axis = 0; axis < 3; ++axis)
        columns_[axis][static_cast<size_t>(k / kDoubleLanes)][k % kDoubleLanes] = point[axis];
    }
  }

  // The point farthest from the centre (the first of equal ones), and its squared distance.
  std::pair<double, Vec3<double>> farthest(Vec3<double> centre) const {
    Double4 most{-1.0, -1.0, -1.0, -1.0};
    Mask4 at{0, 0, 0, 0};
    for (int64_t k = 0; k < count_; ++k) {
      const Double4 x = columns_[0][k] - centre.x, y = columns_[1][k] - centre.y, z = columns_[2][k] - centre.z;
      const Double4 squared = multiply_add(z, z, multiply_add(y, y, x * x));  // same rounding as `dot`
      const Mask4 is_farther = squared > most;
      most = is_farther ? squared : most;
      at = is_farther ? Mask4{k, k, k, k} : at;
    }
    // Without branches, which would be mispredicted half the time.
    Mask4 place = kDoubleLanes * at + Mask4{0, 1, 2, 3};
    const auto keep_farther = [&](Double4 other, Mask4 other_place) {
      const Mask4 is_farther = (other > most) | ((other == most) & (other_place < place));
      most = is_farther ? other : most;
      place = is_farther ? other_place : place;
    };
    keep_farther(__builtin_shufflevector(most, most, 2, 3, 0, 1), __builtin_shufflevector(place, place, 2, 3, 0, 1));
    keep_farther(__builtin_shufflevector(most, most, 1, 0, 3, 2), __builtin_shufflevector(place, place, 1, 0, 3, 2));
    return {most[0], point(place[0])};
  }

  // Of their box.
  Vec3<double> middle() const {
    Vec3<double> out;
    double* const coordinates[3] = {&out.x, &out.y, &out.z};
    for (int axis = 0; axis < 3; ++axis) {
      Double4 low = columns_[axis][0], high = low;
      for (int64_t k = 1; k < count_; ++k) {
        const Double4 x = columns_[axis][k];
        low = x < low ? x : low;
        high = high < x ? x : high;
      }
      double least = low[0], most = high[0];
      for (int lane = 1; lane < kDoubleLanes; ++lane) {
        least = smaller(least, low[lane]);
        most = larger(most, high[lane]);
      }
      *coordinates[axis] = 0.5 * (least + most);
    }
    return out;
  }

  Vec3<double> point(int64_t place) const {
    const int64_t k = place / kDoubleLanes, lane = place % kDoubleLanes;
    return {columns_[0][k][lane], columns_[1][k][lane], columns_[2][k][lane]};
  }

  // Smallest and largest projection of the points, relative to the centre, on a direction.
  std::pair<double, double> extent(Vec3<double> centre, Vec3<double> direction) const {
    Double4 low{HUGE_VAL, HUGE_VAL, HUGE_VAL, HUGE_VAL}, high = -low;
    const Double4 zero{0.0, 0.0, 0.0, 0.0}, dx = zero + direction.x, dy = zero + direction.y, dz = zero + direction.z;
    for (int64_t k = 0; k < count_; ++k) {
      const Double4 x = columns_[0][k] - centre.x, y = columns_[1][k] - centre.y, z = columns_[2][k] - centre.z;
      const Double4 along = multiply_add(z, dz, multiply_add(y, dy, dx * x));
      low = along < low ? along : low;
      high = high < along ? along : high;
    }
    std::pair<double, double> both{low[0], high[0]};
    for (int lane = 1; lane < kDoubleLanes; ++lane) {
      both = {smaller(both.first, low[lane]), larger(both.second, high[lane])};
    }
    return both;
  }

 private:
  std::array<std::vector<Double4>, 3> columns_;
  int64_t count_ = 0;  // in lanes
};

}  // namespace pgccd
