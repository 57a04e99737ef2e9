// The sphere of a rigid body for the broad phase, with a centre on a straight path.
#pragma once

#include "core/centre_arc.h"

namespace pgccd {

struct MovingSphere {
  Vec3<double> centre_t0, centre_t1;
  double reach;  // radius of a sphere that contains the body throughout
};

PGCCD_HD MovingSphere moving_sphere(const RigidBodies& bodies, int64_t body) {
  const Vec3<double> p0 = load_vec3(bodies.centres.position_t0 + 3 * body);
  const Vec3<double> p1 = load_vec3(bodies.centres.position_t1 + 3 * body);
  const double radius = bodies.centres.radius[body];
  const Vec3<double> centre = mesh_centre(bodies, body);
  if (is_centred(centre)) return {p0, p1, radius};
  const Mat3<double> at_t0 = rotation_matrix(load_quaternion(bodies.orientation + 4 * body));
  const Spin spin = make_spin(load_vec3(bodies.rotation + 3 * body));
  if (!(spin.angle <= 2.0 * kLargestAngle)) return {p0, p1, NAN};  // reported by the motion's checks
  const Vec3<double> start = at_t0 * centre, end = rotate(spin, sine_cosine(spin.angle), start);
  const double bulge = bodies.linear_path ? 0.0 : arc_bulge(spin.angle, distance_from_axis(at_t0, spin, centre));
  // Error of the offsets, and of adding them to positions: one unit in each of three coordinates, and sqrt(3) < 2.
  const double rounding = centre_offset_error(spin.angle, centre) +
                          2.0 * Precision<double>::unit * (larger(max_abs(p0), max_abs(p1)) + norm(centre));
  return {p0 + start, p1 + end, (radius + bulge + rounding) * (1.0 + 0x1p-50)};
}

}  // namespace pgccd
