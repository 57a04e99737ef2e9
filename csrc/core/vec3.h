// Three-component vectors and 3 x 3 matrices. The order of evaluation is fixed, for equal bits on every backend; except
// that GCC computes -dot(a, b) as fma(-a.z, b.z, -...), whose zero has the other sign. So no result may depend on the
// sign of a zero: compare before dividing by what may be zero.
#pragma once

#include <type_traits>

#include "core/float8.h"

namespace pgccd {

template <class T>
struct Vec3 {
  T x, y, z;
};

template <class T>
PGCCD_HD Vec3<T> operator+(Vec3<T> a, Vec3<T> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T>
PGCCD_HD Vec3<T> operator-(Vec3<T> a, Vec3<T> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T>
PGCCD_HD Vec3<T> operator-(Vec3<T> a) {
  return {-a.x, -a.y, -a.z};
}
template <class T>
PGCCD_HD Vec3<T> operator*(T s, Vec3<T> a) {
  return {s * a.x, s * a.y, s * a.z};
}
// Scales lanes of vectors by one number.
template <class T, class S>
  requires(!std::is_same_v<T, S>)
PGCCD_HD Vec3<T> operator*(S s, Vec3<T> a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class T>
PGCCD_HD T dot(Vec3<T> a, Vec3<T> b) {
  return multiply_add(a.z, b.z, multiply_add(a.y, b.y, a.x * b.x));
}
template <class T>
PGCCD_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
PGCCD_HD T norm_squared(Vec3<T> a) {
  return dot(a, a);
}
template <class T>
PGCCD_HD T norm(Vec3<T> a) {
  return square_root(dot(a, a));
}
template <class T>
PGCCD_HD T sum_of_magnitudes(Vec3<T> a) {
  return (magnitude(a.x) + magnitude(a.y)) + magnitude(a.z);
}
template <class T>
PGCCD_HD T max_abs(Vec3<T> a) {
  return larger(larger(magnitude(a.x), magnitude(a.y)), magnitude(a.z));
}

template <class To, class From>
PGCCD_HD Vec3<To> cast(Vec3<From> a) {
  return {static_cast<To>(a.x), static_cast<To>(a.y), static_cast<To>(a.z)};
}

template <class T>
PGCCD_HD Vec3<T> load_vec3(const T* row) {
  return {row[0], row[1], row[2]};
}

template <class T>
PGCCD_HD void store_vec3(T* row, Vec3<T> v) {
  row[0] = v.x;
  row[1] = v.y;
  row[2] = v.z;
}

// Row-major 3 x 3 matrix, stored by rows.
template <class T>
struct Mat3 {
  Vec3<T> r0, r1, r2;
};

template <class T>
PGCCD_HD Vec3<T> operator*(const Mat3<T>& m, Vec3<T> v) {
  return {dot(m.r0, v), dot(m.r1, v), dot(m.r2, v)};
}

template <class T>
PGCCD_HD Mat3<T> identity() {
  return {{T(1), T(0), T(0)}, {T(0), T(1), T(0)}, {T(0), T(0), T(1)}};
}

}  // namespace pgccd
