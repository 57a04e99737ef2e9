// Where the bodies of a robot are in a configuration, and how far they are from the arcs that are tested in its place.
// docs/explanation/exactness.md, section 14, has the proof.
#pragma once

#include "core/rotation.h"
#include "core/rounding.h"
#include "kernels/arms/arm.h"

namespace pgccd {

struct RigidPose {
  Vec3<double> position;
  Quaternion orientation;
};

// A vector rotated by a unit quaternion.
PGCCD_HD Vec3<double> rotated(const Quaternion& q, Vec3<double> v) {
  const Vec3<double> twice = 2.0 * cross(q.v, v);
  return (v + q.w * twice) + cross(q.v, twice);
}

PGCCD_HD RigidPose operator*(const RigidPose& outer, const RigidPose& inner) {
  return {outer.position + rotated(outer.orientation, inner.position), outer.orientation * inner.orientation};
}

PGCCD_HD double value_of(const JointPlace& place, double coordinate) {
  return place.scale * coordinate + place.offset;
}

// A coordinate at time s of a segment.
PGCCD_HD double coordinate_at(double begin, double end, double s) { return s == 1.0 ? end : begin + s * (end - begin); }

// The frame of a joint in its parent.
PGCCD_HD RigidPose joint_pose(const Joint& joint, const JointPlace& place, double value) {
  RigidPose pose{load_vec3(place.position), load_quaternion(place.orientation)};
  const Vec3<double> axis = load_vec3(place.axis);
  if (joint.turns()) {
    const SineCosine half = sine_cosine(0.5 * magnitude(value));
    pose.orientation = pose.orientation * Quaternion{half.cosine, (value < 0.0 ? -half.sine : half.sine) * axis};
  } else if (joint.slides()) {
    pose.position = pose.position + rotated(pose.orientation, value * axis);
  }
  return pose;
}

// Part of a segment between two waypoints (coordinates,), from one time to another.
struct ArmSpan {
  const double* from;
  const double* to;
  double begin, end;

  PGCCD_HD double coordinate(int32_t k, double s) const { return coordinate_at(from[k], to[k], s); }
  PGCCD_HD double value(const Arm& arm, int32_t joint, double s) const {
    const int32_t k = arm.joints[joint].coordinate;
    return k < 0 ? 0.0 : value_of(arm.places[joint], coordinate(k, s));
  }
  // By how much the value of a joint changes.
  PGCCD_HD double step(const Arm& arm, int32_t joint) const {
    return magnitude(value(arm, joint, end) - value(arm, joint, begin));
  }
  // Rounding of values grows with the waypoints, also where they are near zero.
  PGCCD_HD double largest_value(const Arm& arm, int32_t joint) const {
    const int32_t k = arm.joints[joint].coordinate;
    if (k < 0) return 0.0;
    const JointPlace& place = arm.places[joint];
    return larger(magnitude(from[k]), magnitude(to[k])) * magnitude(place.scale) + magnitude(place.offset);
  }
};

// A body on an arc: its pose at the begin, its rotation and where it ends, and how far its points are from their places
// on it at any equal time, at most.
struct ArmArc {
  RigidPose start;
  Vec3<double> end, rotation;
  double stray;
};

namespace arm_detail {

// Of the rate and the angle, in units of the change of the rate: see the proof.
constexpr double kRate = 0.7625, kAngle = 0.25625;
// Rounding of the sums and products of a bound.
constexpr double kBoundRounding = 1.0 + 0x1p-40;
// Error of a computed pose, in units of the length of the chain and for each joint and radian.
constexpr double kPoseError = 0x1p-46;

// What joints above one in its chain, up to a frame, contribute.
struct Above {
  double turn = 0.0;   // sum of their turns
  double cross = 0.0;  // the same, each times the sine of the angle between both axes
};

PGCCD_HD Above joints_above(const Arm& arm, const ArmSpan& span, int32_t joint, int32_t frame) {
  Above above;
  for (int32_t k = arm.joints[joint].parent; k != frame; k = arm.joints[k].parent) {
    if (!arm.joints[k].turns()) continue;
    const double step = span.step(arm, k);
    above.turn += step;
    above.cross += step * arm.crossing[k * arm.joint_count + joint];
  }
  return above;
}

}  // namespace arm_detail

// The arc of a body in a frame that carries it, or in the world, over a part of a segment in which the joints between
// turn by at most `kMostTurn`, added. From the body's frame up to that one: both end poses, and the bounds.
PGCCD_HD ArmArc arc_of_body(const Arm& arm, const ArmSpan& span, int64_t body, int32_t frame) {
  const double reach = arm.body_reach[body];
  const bool rests = span.begin == span.end;
  RigidPose start{{0.0, 0.0, 0.0}, {1.0, {0.0, 0.0, 0.0}}}, end = start;
  double acceleration = 0.0, length = 0.0, speed = 0.0;  // of the origin of the body's frame
  double turn = 0.0, bend = 0.0;                         // of the body, and of its rate
  double error_length = reach, error_count = 1.0;
  for (int32_t k = arm.body_frame[body]; k != frame; k = arm.joints[k].parent) {
    const Joint& joint = arm.joints[k];
    const JointPlace& place = arm.places[k];
    const double from = span.value(arm, k, span.begin), to = span.value(arm, k, span.end);
    const double largest = span.largest_value(arm, k);
    error_length += place.distance + (joint.slides() ? largest : 0.0);
    error_count += 1.0 + (joint.turns() ? largest : 0.0);
    if (!rests && !(joint.kind == static_cast<int32_t>(JointKind::kFixed))) {
      const double step = magnitude(to - from);
      const arm_detail::Above above = arm_detail::joints_above(arm, span, k, frame);
      if (joint.slides()) {
        acceleration += 2.0 * (step * above.turn);
        speed += step;
        length += larger(magnitude(from), magnitude(to));
      } else {
        // The distance of the joint from the origin changes by at most `speed`, so it is at most halfway above both
        // ends.
        const double away = smaller(length, 0.5 * ((norm(start.position) + norm(end.position)) + speed));
        acceleration += away * (step * (step + 2.0 * above.turn));
        speed += step * away;
        turn += step;
        bend += step * above.cross;
      }
    }
    length += place.distance;
    start = joint_pose(joint, place, from) * start;
    end = rests ? start : joint_pose(joint, place, to) * end;
  }
  double stray = arm_detail::kPoseError * (error_count * error_length);
  if (arm.body_frame[body] == frame) stray = 0.0;
  if (rests) return {start, start.position, {0.0, 0.0, 0.0}, stray};
  const double of_rotation =
      smaller((1.0 + 2.0 * arm_detail::kRate * turn + arm_detail::kAngle * (turn * turn)) * 0.125, arm_detail::kAngle);
  stray += (0.125 * acceleration + reach * (bend * of_rotation)) * arm_detail::kBoundRounding;
  return {start, end.position, rotation_between(start.orientation, end.orientation), stray};
}

// The bound holds for bodies that turn by at most so many radians in a part of a segment, the turns of all joints
// added.
constexpr double kMostTurn = 1.0;
// Radians that a body may turn between two waypoints, added in the same way: a segment is first split into about as
// many parts.
constexpr double kLongestTurn = 1e4;
// Larger values of joints, radians or length units, have no poses.
constexpr double kLargestJointValue = 1e6;

// By how much bodies turn at most in a part of a segment, the turns of all joints added, rounded up.
PGCCD_HD double most_turn(const Arm& arm, const ArmSpan& span) {
  double most = 0.0;
  for (int64_t body = 0; body < arm.body_count; ++body) {
    double turn = 0.0;
    for (int32_t k = arm.body_frame[body]; k != kWorld; k = arm.joints[k].parent) {
      const int32_t coordinate = arm.joints[k].coordinate;
      if (arm.joints[k].turns()) {
        turn += magnitude((span.to[coordinate] - span.from[coordinate]) * arm.places[k].scale);
      }
    }
    most = turn > most || turn != turn ? turn : most;
  }
  return most * arm_detail::kBoundRounding;
}

}  // namespace pgccd
