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
