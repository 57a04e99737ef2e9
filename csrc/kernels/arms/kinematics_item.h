// Where the bodies of a robot are in a configuration, and how far they are from the arcs that are tested in its place.
// docs/explanation/exactness.md, section 14, has the proof.
#pragma once

#include "core/rotation.h"
#include "core/rounding.h"
#include "kernels/arms/curve_item.h"

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

PGCCD_HD double value_of(const JointPlace& place, double coordinate) { return place.scale * coordinate + place.offset; }

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

// Part of a segment, from one time to another.
struct ArmSpan {
  JointCurve curve;
  double begin, end;

  PGCCD_HD double value(const Joint& joint, const JointPlace& place, double s) const {
    return value_of(place, curve.value(joint.coordinate, s));
  }
};

// A joint of a chain over a part of a segment.
struct JointMotion {
  RigidPose begin, end;  // of its frame in that of the chain
  double step;           // by how much its value changes
  double extent;         // the larger magnitude of its values at both ends
  double largest;        // of its values in the segment: rounding grows with them, also where values are near zero
  double deviation;      // of its value, from one that changes at a constant rate
  double turn_before;    // by how much joints before it turn, added
  double cross_before;   // the same, each times the sine of the angle between both axes
};

// The last frames of the chain of a body, and memory for the motions of their joints, by frame.
struct JointChain {
  const int32_t* frames;
  int32_t count;
  JointMotion* motions;

  PGCCD_HD JointMotion& motion(int32_t n) const { return motions[frames[n]]; }
};

PGCCD_HD JointChain chain_of(const Arm& arm, int64_t body, int32_t shared, JointMotion* motions) {
  const int32_t begin = arm.chain_begin[body] + shared;
  return {arm.chain + begin, arm.chain_begin[body + 1] - begin, motions};
}

// Computes the n-th motion of a chain, after those before it.
PGCCD_HD void place_joint(const Arm& arm, const ArmSpan& span, const JointChain& chain, int32_t n) {
  const int32_t k = chain.frames[n];
  const Joint& joint = arm.joints[k];
  const JointPlace& place = arm.places[k];
  JointMotion motion{};
  double from = 0.0, to = 0.0;
  if (joint.moves()) {
    from = span.value(joint, place, span.begin);
    to = span.value(joint, place, span.end);
    const double scale = magnitude(place.scale);
    motion.largest = span.curve.largest(joint.coordinate) * scale + magnitude(place.offset);
    motion.deviation = span.curve.deviation(joint.coordinate, span.begin, span.end) * scale;
  }
  motion.step = magnitude(to - from);
  motion.extent = larger(magnitude(from), magnitude(to));
  motion.begin = motion.end = joint_pose(joint, place, from);
  if (to != from) motion.end = joint_pose(joint, place, to);
  if (n > 0) {
    const JointMotion& before = chain.motion(n - 1);
    motion.begin = before.begin * motion.begin;
    motion.end = before.end * motion.end;
    motion.turn_before = before.turn_before + (arm.joints[chain.frames[n - 1]].turns() ? before.step : 0.0);
  }
  if (motion.step > 0.0 && joint.turns()) {
    for (int32_t m = 0; m < n; ++m) {
      if (!arm.joints[chain.frames[m]].turns()) continue;
      motion.cross_before += chain.motion(m).step * arm.crossing[chain.frames[m] * arm.joint_count + k];
    }
  }
  chain.motion(n) = motion;
}

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

}  // namespace arm_detail

// The arc of a body in the frame of its chain, whose joints turn by at most `kMostTurn`, added, and whose motions are
// known; `rests`: at a single time.
PGCCD_HD ArmArc arc_of_body(const Arm& arm, const JointChain& chain, bool rests, double reach) {
  const RigidPose origin{{0.0, 0.0, 0.0}, {1.0, {0.0, 0.0, 0.0}}};
  if (chain.count == 0) return {origin, origin.position, {0.0, 0.0, 0.0}, 0.0};
  const RigidPose start = chain.motion(chain.count - 1).begin, end = chain.motion(chain.count - 1).end;
  double acceleration = 0.0, length = 0.0, speed = 0.0;  // of the origin of the body's frame
  double turn = 0.0, bend = 0.0;                         // of the body, and of its rate
  double deviation = 0.0;  // of its points, from where they were if joints moved at constant rates
  double error_length = reach, error_count = 1.0;
  for (int32_t n = chain.count - 1; n >= 0; --n) {
    const Joint& joint = arm.joints[chain.frames[n]];
    const JointMotion& motion = chain.motion(n);
    const double distance = arm.places[chain.frames[n]].distance;
    error_length += distance + (joint.slides() ? motion.largest : 0.0);
    error_count += 1.0 + (joint.turns() ? motion.largest : 0.0);
    if (joint.slides()) {
      acceleration += 2.0 * (motion.step * motion.turn_before);
      speed += motion.step;
      length += motion.extent;
      deviation += motion.deviation;
    } else if (motion.step > 0.0 || motion.deviation > 0.0) {
      // The distance of the joint from the origin changes by at most `speed`, so it is at most halfway above both ends.
      const double ends = norm(motion.begin.position - start.position) + norm(motion.end.position - end.position);
      const double away = smaller(length, 0.5 * (ends + speed));
      acceleration += away * (motion.step * (motion.step + 2.0 * motion.turn_before));
      speed += motion.step * away;
      turn += motion.step;
      bend += motion.step * motion.cross_before;
      deviation += motion.deviation * (away + reach);
    }
    length += distance;
  }
  const double error = arm_detail::kPoseError * (error_count * error_length);
  if (rests) return {start, start.position, {0.0, 0.0, 0.0}, error + deviation * arm_detail::kBoundRounding};
  const double of_rotation =
      smaller((1.0 + 2.0 * arm_detail::kRate * turn + arm_detail::kAngle * (turn * turn)) * 0.125, arm_detail::kAngle);
  const double bound = (0.125 * acceleration + reach * (bend * of_rotation) + deviation) * arm_detail::kBoundRounding;
  return {start, end.position, rotation_between(start.orientation, end.orientation), bound + error};
}

// The bound holds for bodies that turn by at most so many radians in a part of a segment, the turns of all joints
// added.
constexpr double kMostTurn = 1.0;
// Radians that a body may turn in a segment, added in the same way: it is first split into about as many parts.
constexpr double kLongestTurn = 1e4;
// Larger values of joints, radians or length units, have no poses.
constexpr double kLargestJointValue = 1e6;

// By how much bodies turn at most in a segment, the turns of all joints added, rounded up.
PGCCD_HD double most_turn(const Arm& arm, const JointCurve& curve) {
  double most = 0.0;
  for (int64_t body = 0; body < arm.body_count; ++body) {
    double turn = 0.0;
    for (int32_t n = arm.chain_begin[body]; n < arm.chain_begin[body + 1]; ++n) {
      const int32_t k = arm.chain[n];
      if (arm.joints[k].turns()) turn += curve.rate(arm.joints[k].coordinate) * magnitude(arm.places[k].scale);
    }
    most = turn > most || turn != turn ? turn : most;
  }
  return most * arm_detail::kBoundRounding;
}

}  // namespace pgccd
