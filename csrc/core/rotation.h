// Unit quaternions (w, x, y, z), rotation vectors, and their matrices.
#pragma once

#include "core/trig.h"
#include "core/vec3.h"

namespace pgccd {

struct Quaternion {
  double w;
  Vec3<double> v;
};

PGCCD_HD Quaternion load_quaternion(const double* row) { return {row[0], {row[1], row[2], row[3]}}; }

PGCCD_HD Quaternion conjugate(Quaternion q) { return {q.w, -q.v}; }

PGCCD_HD Quaternion operator*(Quaternion a, Quaternion b) {
  return {a.w * b.w - dot(a.v, b.v), (a.w * b.v + b.w * a.v) + cross(a.v, b.v)};
}

PGCCD_HD Quaternion normalized(Quaternion q) {
  const double inverse = 1.0 / std::sqrt(q.w * q.w + norm_squared(q.v));
  return {q.w * inverse, inverse * q.v};
}

// The rotation of q / |q|: dividing by |q|^2 makes a quaternion that is only nearly unit an exact rotation.
template <class T = double>
PGCCD_HD Mat3<T> rotation_matrix(Quaternion q) {
  const T w(q.w), one(1.0);
  const Vec3<T> v = cast<T>(q.v);
  const T s = T(2.0) / (w * w + norm_squared(v));
  const T xs = s * v.x, ys = s * v.y, zs = s * v.z;
  const T wx = w * xs, wy = w * ys, wz = w * zs;
  const T xx = v.x * xs, xy = v.x * ys, xz = v.x * zs;
  const T yy = v.y * ys, yz = v.y * zs, zz = v.z * zs;
  return {
      {one - (yy + zz), xy - wz, xz + wy}, {xy + wz, one - (xx + zz), yz - wx}, {xz - wy, yz + wx, one - (xx + yy)}};
}

// Unit quaternion of exp([w]x).
PGCCD_HD Quaternion exponential(Vec3<double> rotation) {
  const double angle = norm(rotation);
  if (angle == 0.0) return {1.0, {0.0, 0.0, 0.0}};
  const SineCosine half = sine_cosine(0.5 * angle);
  return {half.cosine, (half.sine / angle) * rotation};
}

// World-frame rotation vector from q0 to q1, the shorter way; at exactly half a turn, about the vector part of q1 *
// conj(q0) as computed.
PGCCD_HD Vec3<double> rotation_between(Quaternion q0, Quaternion q1) {
  Quaternion turn = normalized(q1) * conjugate(normalized(q0));
  if (turn.w < 0.0) turn = {-turn.w, -turn.v};
  const double sine = norm(turn.v);
  if (sine == 0.0) return {0.0, 0.0, 0.0};
  return (2.0 * first_quadrant_angle(sine, turn.w) / sine) * turn.v;
}

// A rotation about a fixed world axis at constant rate: exp(t [w]x), applied by Rodrigues' formula.
struct Spin {
  Vec3<double> axis;  // unit
  double angle;       // over the whole step, radians, >= 0
};

PGCCD_HD Spin make_spin(Vec3<double> rotation) {
  const double angle = norm(rotation);
  if (angle == 0.0) return {{0.0, 0.0, 1.0}, 0.0};
  return {(1.0 / angle) * rotation, angle};
}

template <class T>
PGCCD_HD Vec3<T> rotate(const Spin& spin, const SineCosine& at, Vec3<T> v) {
  const Vec3<T> axis = cast<T>(spin.axis), k = cross(axis, v);
  return v + (T(at.sine) * k + T(at.versine) * cross(axis, k));
}

// Unit quaternion at time t of a body that turns by a rotation vector per step; NaN for an angle without proven bounds.
PGCCD_HD Quaternion orientation_at(Quaternion start, Vec3<double> rotation, double t) {
  const Spin spin = make_spin(rotation);
  const double half_angle = 0.5 * (spin.angle * t);
  Quaternion turn{NAN, {NAN, NAN, NAN}};  // of invalid input, reported by checks
  if (half_angle <= kLargestAngle) {
    const SineCosine half = sine_cosine(half_angle);
    turn = {half.cosine, half.sine * spin.axis};
  }
  return turn * normalized(start);
}

// exp(t [w]x) R0
PGCCD_HD Mat3<double> spun(const Spin& spin, const Mat3<double>& r0, double t) {
  const SineCosine at = sine_cosine(spin.angle * t);
  const Vec3<double> c0 = rotate(spin, at, Vec3<double>{r0.r0.x, r0.r1.x, r0.r2.x});
  const Vec3<double> c1 = rotate(spin, at, Vec3<double>{r0.r0.y, r0.r1.y, r0.r2.y});
  const Vec3<double> c2 = rotate(spin, at, Vec3<double>{r0.r0.z, r0.r1.z, r0.r2.z});
  return {{c0.x, c1.x, c2.x}, {c0.y, c1.y, c2.y}, {c0.z, c1.z, c2.z}};
}

}  // namespace pgccd
