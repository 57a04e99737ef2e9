// Motions of planners, one after another on one thread of the host. What is learned of a pair is kept: how far apart it
// certainly is in some configuration.
#pragma once

#include <vector>

#include "kernels/arms/host_team.h"

namespace pgccd {

// A pair in a configuration, in its frame, and a distance that its bodies certainly exceed there.
struct KnownDistance {
  double lower = 0.0;  // 0: none
  Vec3<double> position[2]{};
  Quaternion orientation[2]{};
  // Of the pair since its distance was last asked for: tests, and spans that needed none; and after how many tests it
  // is asked for again, more each time that it has not been of use.
  int32_t tests = 0, uses = 0, patience = 1;
};

// The distance that has to be known of a pair there, so that no contact of it is reported over a span: bodies (2) and
// how far each strays from its arc; `reach`: bounds of the distances of their points from their origins.
//
// On its way from the configuration that is known, a point moves by at most the way of the origin and, for the
// rotation, twice the distance of the quaternions times its distance from there; then along the arc, from which it
// strays. A contact is reported of bodies that come within the resolution, or within twice their strays.
inline double needed_distance(const KnownDistance& known, const RigidBodies& bodies, const double (&stray)[2],
                              const double (&reach)[2], double resolution) {
  // Roundings of sums of lengths, and of the lengths of quaternions.
  constexpr double kSumRounding = 1.0 + 0x1p-30;
  double distance = resolution;
  for (int side = 0; side < 2; ++side) {
    const Vec3<double> start = load_vec3(bodies.centres.position_t0 + 3 * side);
    const Vec3<double> end = load_vec3(bodies.centres.position_t1 + 3 * side);
    const Quaternion now = load_quaternion(bodies.orientation + 4 * side), then = known.orientation[side];
    const auto apart = [&](double sign) {
      const double w = now.w + sign * then.w;
      return std::sqrt(w * w + norm_squared(now.v + sign * then.v));
    };
    const double turn = 2.0 * smaller(apart(-1.0), apart(1.0)) + norm(load_vec3(bodies.rotation + 3 * side));
    distance += norm(start - known.position[side]) + norm(end - start) + reach[side] * turn + 3.0 * stray[side];
  }
  return distance * kSumRounding;
}

class ValidatorTeam : public HostTeam {
 public:
  ValidatorTeam(const ArmScene& scene, double resolution)
      : scene_(scene), resolution_(resolution), known_(scene.pair_count) {}

  // Whether a pair, placed over a span, is certainly further apart than any contact that the search would report, since
  // its bodies move too little from where their distance is known. The search would then find the same.
  bool is_known_apart(int64_t pair, const RigidBodies& bodies) {
    KnownDistance& known = known_[pair];
    if (!(known.lower > 0.0) || !(known.lower > needed(pair, bodies, known))) return false;
    ++known.uses;
    return true;
  }

  // Of a pair that was found free over a span, at the start of it: its distance, if it has been tested before.
  void learn(int64_t pair, const RigidBodies& bodies);

 private:
  // The distance that has to be known.
  double needed(int64_t pair, const RigidBodies& bodies, const KnownDistance& known);
  double reach_of(int64_t pair, const RigidBodies& bodies, int side) const;

  const ArmScene& scene_;
  double resolution_;
  std::vector<KnownDistance> known_;
};

class MotionValidator {
 public:
  MotionValidator(const ArmScene& scene, double resolution);
  MotionValidator(const MotionValidator& other) : MotionValidator(other.scene_, other.resolution_) {}

  // `wants_first`: the first contact; else any of them, and the pair that failed last is tested first.
  PathVerdict check_motion(const double* start, const double* goal, int64_t budget, bool wants_first);
  // Whether no two bodies touch in a configuration.
  bool check_state(const double* state);

  const ArmScene& scene() const { return scene_; }

 private:
  ArmScene scene_;
  double resolution_;
  std::vector<double> waypoints_, memory_;
  ArmPaths paths_;
  ValidatorTeam team_;
  PathSearch<ValidatorTeam> search_;
  int64_t failed_last_ = -1;
};

}  // namespace pgccd
