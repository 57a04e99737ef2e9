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
PGCCD_HD Mat3<double> rotation_matrix(Quaternion q) {
  const double s = 2.0 / (q.w * q.w + norm_squared(q.v));
  const double xs = s * q.v.x, ys = s * q.v.y, zs = s * q.v.z;
  const double wx = q.w * xs, wy = q.w * ys, wz = q.w * zs;
  const double xx = q.v.x * xs, xy = q.v.x * ys, xz = q.v.x * zs;
  const double yy = q.v.y * ys, yz = q.v.y * zs, zz = q.v.z * zs;
  return {
      {1.0 - (yy + zz), xy - wz, xz + wy}, {xy + wz, 1.0 - (xx + zz), yz - wx}, {xz - wy, yz + wx, 1.0 - (xx + yy)}};
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

PGCCD_HD Vec3<double> rotate(const Spin& spin, const SineCosine& at, Vec3<double> v) {
  const Vec3<double> k = cross(spin.axis, v);
  return v + (at.sine * k + at.versine * cross(spin.axis, k));
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
