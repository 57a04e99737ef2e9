#include <algorithm>
#include <limits>

#include "kernels/arms/validator.h"

namespace pgccd {
namespace {

// A distance is asked for that suffices for motions so many times as long.
constexpr double kLonger = 3.0;
constexpr int32_t kMostPatience = 256;

}  // namespace

double ValidatorTeam::reach_of(int64_t pair, const RigidBodies& bodies, int side) const {
  const int64_t body = side == 0 ? scene_.pairs[pair].first : scene_.pairs[pair].second;
  return body < scene_.arm.body_count ? scene_.arm.body_reach[body] : mesh_reach(bodies, side);
}

double ValidatorTeam::needed(int64_t pair, const RigidBodies& bodies, const KnownDistance& known) {
  const double reach[2] = {reach_of(pair, bodies, 0), reach_of(pair, bodies, 1)};
  return needed_distance(known, bodies, this->pair().stray, reach, resolution_);
}

void ValidatorTeam::learn(int64_t pair, const RigidBodies& bodies) {
  KnownDistance& known = known_[pair];
  if (known.tests++ < known.patience) return;
  KnownDistance here;
  here.patience = known.uses > 0 ? 1 : std::min(2 * known.patience, kMostPatience);
  for (int side = 0; side < 2; ++side) {
    here.position[side] = load_vec3(bodies.centres.position_t0 + 3 * side);
    here.orientation[side] = load_quaternion(bodies.orientation + 4 * side);
  }
  const double wanted = kLonger * needed(pair, bodies, here);
  ArcRows<2> rest = this->pair().rows;
  const ArcColumns columns{rest.position_t0, rest.position_t1, rest.orientation, rest.rotation,
                           rest.radius,      rest.margin,      rest.mesh_index};
  std::copy_n(rest.position_t0, 6, rest.position_t1);
  std::fill_n(rest.rotation, 6, 0.0);
  const RigidBodies at_rest = columns.bodies(bodies.meshes, 2);
  if (free_until(at_rest, {wanted, false, false}) == std::numeric_limits<double>::infinity()) here.lower = wanted;
  known = here;
}

MotionValidator::MotionValidator(const ArmScene& scene, double resolution)
    : scene_(scene),
      resolution_(resolution),
      waypoints_(2 * scene.arm.coordinate_count),
      memory_(SearchMemory::bytes(scene) / sizeof(double)),
      paths_{waypoints_.data(), 1, 2},
      team_(scene_, resolution),
      search_(scene_, paths_, resolution, {scene_, reinterpret_cast<char*>(memory_.data())}, team_) {}

PathVerdict MotionValidator::check_motion(const double* start, const double* goal, int64_t budget, bool wants_first) {
  const int64_t count = scene_.arm.coordinate_count;
  std::copy_n(start, count, waypoints_.data());
  std::copy_n(goal, count, waypoints_.data() + count);
  const PathVerdict found = search_.certify(0, {false, !wants_first, wants_first ? -1 : failed_last_, budget});
  if (found.first.pair >= 0) failed_last_ = found.first.pair;
  return found;
}

bool MotionValidator::check_state(const double* state) {
  const int64_t count = scene_.arm.coordinate_count;
  std::copy_n(state, count, waypoints_.data());
  std::copy_n(state, count, waypoints_.data() + count);
  const int64_t touching = search_.find_touching(0, failed_last_);
  if (touching >= 0) failed_last_ = touching;
  return touching == kNoPair;
}

}  // namespace pgccd
