// One robot of the nanorobot simulation: its initial state, its plan for a step, and its response to a collision.
#pragma once

#include "core/random.h"
#include "kernels/simulate/robot.h"
#include "kernels/simulate/world.h"

namespace pgccd {

namespace robot_detail {

enum Stream : uint32_t {
  kPlaceStream,
  kOrientationStream,
  kCourseStream,
  kSpinStream,
  kDecisionStream,
};

constexpr double kTwoPi = 0x1.921fb54442d18p+2;
// Fraction of the gap between neighbouring spheres at the start that is used for jitter; the rest keeps them apart.
constexpr double kJitter = 0.95;
// A robot's heading deviates from the straight course by about this angle, in radians.
constexpr double kHeadingSpread = 0.3;
// Fraction of their speed at which robots move while staying in a corner.
constexpr double kStayingSpeed = 0.25;

PGCCD_HD Uniforms draw(const World& world, int64_t id, int64_t step, Stream stream) {
  return random_uniforms(world.seed, {id, static_cast<uint32_t>(step), stream});
}

// Uniform on the unit sphere: Archimedes' cylinder.
PGCCD_HD Vec3<double> direction(double u, double v) {
  const double z = 2.0 * u - 1.0;
  const double r = std::sqrt(1.0 - z * z);
  const SineCosine at = sine_cosine(kTwoPi * v);
  return {r * at.cosine, r * at.sine, z};
}

// Uniform on the unit quaternions (Shoemake 1992).
PGCCD_HD Quaternion random_orientation(const Uniforms& r) {
  const SineCosine a = sine_cosine(kTwoPi * r.u[1]), b = sine_cosine(kTwoPi * r.u[2]);
  const double s = std::sqrt(1.0 - r.u[0]), t = std::sqrt(r.u[0]);
  return normalized({t * b.cosine, {s * a.sine, s * a.cosine, t * b.sine}});
}

PGCCD_HD int64_t nearest_corner(Vec3<double> position) {
  return (position.x > 0.0 ? 1 : 0) | (position.y > 0.0 ? 2 : 0) | (position.z > 0.0 ? 4 : 0);
}

PGCCD_HD Vec3<double> corner(const World& world, int64_t target) {
  const Vec3<double> half = world.half_extent();
  const Vec3<double> reach = {half.x - world.radius, half.y - world.radius, half.z - world.radius};
  return {(target & 1) ? reach.x : -reach.x, (target & 2) ? reach.y : -reach.y, (target & 4) ? reach.z : -reach.z};
}

PGCCD_HD void set_random_course(const World& world, int64_t id, int64_t step, double fraction, Robot& robot) {
  const Uniforms course = draw(world, id, step, kCourseStream), spin = draw(world, id, step, kSpinStream);
  const double speed = world.speed * world.radius * (0.5 + course.u[2]) * fraction;
  robot.velocity = speed * direction(course.u[0], course.u[1]);
  robot.angular_velocity = (world.spin * spin.u[2]) * direction(spin.u[0], spin.u[1]);
}

PGCCD_HD void set_course_to_target(const World& world, int64_t id, int64_t step, Robot& robot) {
  set_random_course(world, id, step, 1.0, robot);
  const double speed = norm(robot.velocity);
  const Vec3<double> way = corner(world, robot.target) - robot.position;
  const double distance = norm(way);
  if (speed == 0.0 || distance == 0.0) return;
  const Vec3<double> heading = (1.0 / distance) * way + (kHeadingSpread / speed) * robot.velocity;
  robot.velocity = (speed / norm(heading)) * heading;  // |heading| >= 1 - kHeadingSpread
}

PGCCD_HD void plan_skewed(const World& world, int64_t id, int64_t step, Robot& robot) {
  const Uniforms decision = draw(world, id, step, kDecisionStream);
  if (robot.stay_until != kNotStaying) {
    if (step >= robot.stay_until) {
      // Along an edge of the box: courses across it would all meet in the middle.
      robot.target ^= int64_t{1} << static_cast<int>(3.0 * decision.u[1]);
      robot.stay_until = kNotStaying;
      set_course_to_target(world, id, step, robot);
    } else if (decision.u[0] < world.course_change) {
      set_random_course(world, id, step, kStayingSpeed, robot);
    }
    return;
  }
  const Vec3<double> half = world.half_extent();
  const double edge = 2.0 * smaller(half.x, smaller(half.y, half.z));
  const Vec3<double> way = corner(world, robot.target) - robot.position;
  const double distance = norm(way);
  const bool thrown_back = dot(way, robot.velocity) < 0.0;
  if (distance <= world.arrival * edge || (thrown_back && distance <= world.crowd * edge)) {
    const double choices = static_cast<double>(world.stay_longest - world.stay_shortest + 1);
    robot.stay_until = step + world.stay_shortest + static_cast<int64_t>(choices * decision.u[1]);
    set_random_course(world, id, step, kStayingSpeed, robot);
  } else if (thrown_back && decision.u[2] < world.course_change) {
    // A blocked robot gives way; otherwise opposing crowds would block each other forever.
    robot.target = nearest_corner(robot.position);
    set_course_to_target(world, id, step, robot);
  } else if (decision.u[0] < world.resumption) {
    set_course_to_target(world, id, step, robot);
  }
}

// Reverses the velocity component if the step would move the SBV through a wall.
PGCCD_HD double reflected(double position, double velocity, double reach) {
  if (position + velocity > reach) return -std::fabs(velocity);
  if (position + velocity < -reach) return std::fabs(velocity);
  return velocity;
}

}  // namespace robot_detail

// Cells are assigned so that empty ones are distributed over the lattice. Below 2^31 robots no product overflows.
PGCCD_HD Robot start_robot(const World& world, int64_t id) {
  using namespace robot_detail;
  const uint64_t cell_count = static_cast<uint64_t>(world.cells[0] * world.cells[1] * world.cells[2]);
  const int64_t cell =
      static_cast<int64_t>(static_cast<uint64_t>(id) * cell_count / static_cast<uint64_t>(world.robot_count));
  const int64_t column[3] = {cell % world.cells[0], cell / world.cells[0] % world.cells[1],
                             cell / (world.cells[0] * world.cells[1])};
  const Uniforms place = draw(world, id, 0, kPlaceStream);
  double x[3];
  for (int axis = 0; axis < 3; ++axis) {
    const double centre =
        static_cast<double>(column[axis]) + 0.5 - 0.5 * static_cast<double>(world.cells[axis]);  // exact
    const double jitter = kJitter * (0.5 * world.spacing - 1.0) * (2.0 * place.u[axis] - 1.0);
    x[axis] = (centre * world.spacing + jitter) * world.radius;
  }
  Robot robot;
  robot.position = {x[0], x[1], x[2]};
  robot.orientation = random_orientation(draw(world, id, 0, kOrientationStream));
  robot.target = kNoTarget;
  robot.stay_until = kNotStaying;
  if (world.pattern == MovementPattern::kSkewed) {
    robot.target = nearest_corner(robot.position);
    set_course_to_target(world, id, 0, robot);
  } else {
    set_random_course(world, id, 0, 1.0, robot);
  }
  return robot;
}

// Computes the velocities of the step. Step 0 keeps the initial ones.
PGCCD_HD void plan_robot(const World& world, int64_t id, int64_t step, Robot& robot) {
  using namespace robot_detail;
  if (id < 0) return;  // padding does not move
  if (step > 0) {
    if (world.pattern == MovementPattern::kSkewed) {
      plan_skewed(world, id, step, robot);
    } else if (draw(world, id, step, kDecisionStream).u[0] < world.course_change) {
      set_random_course(world, id, step, 1.0, robot);
    }
  }
  const Vec3<double> half = world.half_extent();
  robot.velocity = {reflected(robot.position.x, robot.velocity.x, half.x - world.radius),
                    reflected(robot.position.y, robot.velocity.y, half.y - world.radius),
                    reflected(robot.position.z, robot.velocity.z, half.z - world.radius)};
}

// Moves by `fraction` of the step; a robot with a fraction below 1 reverses (the simple response of Du, Liu & Suzumura
// 2017).
PGCCD_HD void respond_robot(double fraction, Robot& robot) {
  robot.position = robot.position + fraction * robot.velocity;
  robot.orientation = normalized(exponential(fraction * robot.angular_velocity) * robot.orientation);
  if (fraction < 1.0) {
    robot.velocity = -robot.velocity;
    robot.angular_velocity = -robot.angular_velocity;
  }
}

}  // namespace pgccd
