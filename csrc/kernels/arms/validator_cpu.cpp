#include <algorithm>
#include <limits>

#include "kernels/arms/validator.h"

namespace pgccd {
namespace {

// Roundings of sums of lengths, and of the lengths of quaternions.
constexpr double kSumRounding = 1.0 + 0x1p-30;
// A distance is asked for that suffices for motions so many times as long.
constexpr double kLonger = 3.0;
constexpr int32_t kMostPatience = 256;

}  // namespace

double ValidatorTeam::reach_of(int64_t pair, const RigidBodies& bodies, int side) const {
  const int64_t body = side == 0 ? scene_.pairs[pair].first : scene_.pairs[pair].second;
  return body < scene_.arm.body_count ? scene_.arm.body_reach[body] : mesh_reach(bodies, side);
}

// On its way from the configuration that is known, a point moves by at most the way of the origin and, for the
// rotation, twice the distance of the quaternions times its distance from there; then along the arc, from which it
// strays. A contact is reported of bodies that come within the resolution, or within twice their strays.
double ValidatorTeam::needed(int64_t pair, const RigidBodies& bodies, const KnownDistance& known) {
  double distance = resolution_;
  for (int side = 0; side < 2; ++side) {
    const Vec3<double> start = load_vec3(bodies.centres.position_t0 + 3 * side);
    const Vec3<double> end = load_vec3(bodies.centres.position_t1 + 3 * side);
    const Quaternion now = load_quaternion(bodies.orientation + 4 * side), then = known.orientation[side];
    const auto apart = [&](double sign) {
      const double w = now.w + sign * then.w;
      return std::sqrt(w * w + norm_squared(now.v + sign * then.v));
    };
    const double turn = 2.0 * smaller(apart(-1.0), apart(1.0)) + norm(load_vec3(bodies.rotation + 3 * side));
    distance += norm(start - known.position[side]) + norm(end - start) + reach_of(pair, bodies, side) * turn;
    distance += 3.0 * this->pair().stray[side];
  }
  return distance * kSumRounding;
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
