// Path of the SBV centre of a rigid body with its origin elsewhere: an arc about the axis through the origin or, with
// linear paths, the chord of that arc.
#pragma once

#include "core/bodies.h"
#include "core/rounding.h"

namespace pgccd {

PGCCD_HD bool is_centred(Vec3<double> centre) { return centre.x == 0.0 && centre.y == 0.0 && centre.z == 0.0; }

// The SBV centre of the body's mesh, body frame.
PGCCD_HD Vec3<double> mesh_centre(const RigidBodies& bodies, int64_t body) {
  if (bodies.meshes.centres == nullptr) return {0.0, 0.0, 0.0};
  return load_vec3(bodies.meshes.centres + 3 * int64_t{bodies.mesh_index[body]});
}

// Bound of the distance of the body's vertices from its origin.
PGCCD_HD double mesh_reach(const RigidBodies& bodies, int64_t body) {
  return bodies.meshes.reaches == nullptr ? bodies.centres.radius[body]
                                          : bodies.meshes.reaches[bodies.mesh_index[body]];
}

// Distance of the SBV centre from the axis, given the body's orientation at t0. 0 if the centre is the origin.
PGCCD_HD double distance_from_axis(const Mat3<double>& at_t0, const Spin& spin, Vec3<double> centre) {
  if (is_centred(centre)) return 0.0;
  return norm(cross(spin.axis, at_t0 * centre));
}

// Bound of the deviation of an arc of this angle and radius from its chord: angle^2 / 8 of the radius (linear
// interpolation in time), and at most its diameter.
PGCCD_HD double arc_bulge(double angle, double radius) {
  return smaller(0.125 * angle * angle, 2.0) * radius * (1.0 + 0x1p-50);
}

// Error bound of the computed offset of the SBV centre from the origin, as for every mesh point.
PGCCD_HD double centre_offset_error(double angle, Vec3<double> centre) {
  return (kRigidPointUnits + 8.0 * angle) * Precision<double>::unit * norm(centre);
}

}  // namespace pgccd
