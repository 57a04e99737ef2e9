#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "kernels/arms/path_search.h"

namespace pgccd {
namespace {

constexpr double kNever = std::numeric_limits<double>::infinity();
// Configurations behind a contact in which bodies are looked at.
constexpr int kWitnesses = 16;

ArcColumns columns_of(ArcRows<2>& rows) {
  return {rows.position_t0, rows.position_t1, rows.orientation, rows.rotation,
          rows.radius,      rows.margin,      rows.mesh_index};
}

// Whether two bodies may come within the tolerance: by their spheres and boxes.
bool may_touch(const RigidBodies& bodies, double tolerance) {
  double centres[12], reach[2];
  MovingBox boxes[2];
  BroadBodies broad{};
  broad.count = 2;
  broad.centres = {centres, centres + 6, reach, 2};
  broad.tolerance = tolerance;
  for (int side = 0; side < 2; ++side) {
    const MovingSphere sphere = moving_sphere(bodies, side);
    store_vec3(centres + 3 * side, sphere.centre_t0);
    store_vec3(centres + 6 + 3 * side, sphere.centre_t1);
    reach[side] = add_up(sphere.reach, bodies.centres.margin[side]);
  }
  if (!spheres_may_meet(broad, 0, 1)) return false;
  if (bodies.meshes.boxes == nullptr) return true;
  for (int side = 0; side < 2; ++side) boxes[side] = moving_box(SingleThread{}, bodies, side);
  broad.boxes = boxes;
  return boxes_may_meet(broad, 0, 1);
}

}  // namespace

PathSearch::PathSearch(const ArmScene& scene, double resolution) : scene_(scene), resolution_(resolution) {
  const int64_t count = scene.arm.body_count + scene.obstacles.count;
  numbers_.resize(15 * count);
  mesh_index_.resize(count);
  double* next = numbers_.data();
  const auto column = [&](int64_t width) { return std::exchange(next, next + width * count); };
  rows_ = {column(3), column(3), column(4), column(3), column(1), column(1), mesh_index_.data()};
  centres_.resize(7 * count);
  joints_.resize(scene.arm.joint_count);
  is_placed_.resize(scene.arm.joint_count);
  balls_.resize(count);
  spheres_.count = count;
  spheres_.centres = {centres_.data(), centres_.data() + 3 * count, centres_.data() + 6 * count, count};
  spheres_.tolerance = kContactTolerance * resolution;
}

// All bodies, and the spheres that contain them, over a span.
void PathSearch::place_all(const PathSpan& span) {
  ++verdict_.counts[kSpans];
  const Arm& arm = scene_.arm;
  const ArmSpan over = joints_over(paths_, arm, span);
  const RigidBodies bodies = rows_.bodies(scene_.meshes, spheres_.count);
  const int64_t count = spheres_.count;
  double* const centres = centres_.data();
  std::fill(is_placed_.begin(), is_placed_.end(), 0);
  for (int64_t body = 0; body < count; ++body) {
    ArmArc arc;
    if (body < arm.body_count) {
      const JointChain chain = chain_of(arm, body, 0, joints_.data());
      for (int32_t n = 0; n < chain.count; ++n) {
        if (std::exchange(is_placed_[chain.frames[n]], 1) == 0) place_joint(arm, over, chain, n);
      }
      arc = arc_of_body(arm, chain, span.begin == span.end, arm.body_reach[body]);
    } else {
      arc = arc_of_obstacle(body, span);
    }
    rows_.store(body, arc, scene_, body);
    const MovingSphere sphere = moving_sphere(bodies, body);
    const double reach = add_up(sphere.reach, rows_.margin[body]);
    store_vec3(centres + 3 * body, sphere.centre_t0);
    store_vec3(centres + 3 * (count + body), sphere.centre_t1);
    centres[6 * count + body] = reach;
    const Vec3<double> half = 0.5 * (sphere.centre_t1 - sphere.centre_t0);
    balls_[body] = {sphere.centre_t0 + half, reach + norm(half)};
  }
}

ArmArc PathSearch::arc_of_obstacle(int64_t body, const PathSpan& span) const {
  return pgccd::arc_of_obstacle(scene_.obstacles, body - scene_.arm.body_count, span.path, span.segment, span.begin,
                                span.end);
}

// By the spheres of two bodies; first by balls around their whole ways, which reject most pairs.
bool PathSearch::may_meet(const ArmPair& pair) const {
  const Ball &one = balls_[pair.first], &other = balls_[pair.second];
  const Vec3<double> offset = other.centre - one.centre;
  const double reach = (one.radius + other.radius + spheres_.tolerance) * (1.0 + 0x1p-40) +
                       0x1p-48 * (max_abs(one.centre) + max_abs(other.centre));
  return norm_squared(offset) <= reach * reach && spheres_may_meet(spheres_, pair.first, pair.second);
}

// The two bodies of a pair in its frame.
void PathSearch::place_pair(const ArmPair& pair, const PathSpan& span, double& stray) {
  const Arm& arm = scene_.arm;
  stray = 0.0;
  int side = 0;
  for (const int32_t body : {pair.first, pair.second}) {
    ArmArc arc;
    if (body < arm.body_count) {
      const ArmSpan over = joints_over(paths_, arm, span);
      const JointChain chain = chain_of(arm, body, pair.shared, joints_.data());
      for (int32_t n = 0; n < chain.count; ++n) place_joint(arm, over, chain, n);
      arc = arc_of_body(arm, chain, span.begin == span.end, arm.body_reach[body]);
    } else {
      arc = arc_of_obstacle(body, span);
    }
    columns_of(pair_).store(side++, arc, scene_, body);
    stray += arc.stray;
  }
}

// Over a span: the time before which the pair is free, of the first contact where the span is fine.
PathSearch::Touch PathSearch::touch(const ArmPair& pair, const PathSpan& span) {
  ++verdict_.counts[kPairSpans];
  Touch touch;
  place_pair(pair, span, touch.stray);
  const RigidBodies bodies = columns_of(pair_).bodies(scene_.meshes, 2);
  const double tolerance = kContactTolerance * resolution_;
  if (!may_touch(bodies, tolerance)) return touch;
  // Bodies that are apart at the start of a path are so at the start of every later span, unless one before it is not
  // free.
  const PairQuery query{{0, 1}, 0.0, tolerance, span.segment == 0 && span.begin == 0.0, Report::kFirst};
  if (!is_fine(span, touch.stray, resolution_)) {
    touch.toi = one_pair_.free_until(bodies, query);
  } else if (const std::optional<PairContact> found = one_pair_.search(bodies, query)) {
    touch.toi = found->outcome.toi;
    touch.contact = *found;
  }
  return touch;
}

std::optional<PairContact> PathSearch::contact_at_rest(const ArmPair& pair, const PathSpan& still, Report report) {
  ++verdict_.counts[kPairSpans];
  double stray;
  place_pair(pair, still, stray);
  const RigidBodies bodies = columns_of(pair_).bodies(scene_.meshes, 2);
  if (!may_touch(bodies, 0.0)) return {};
  return one_pair_.search(bodies, {{0, 1}, 0.0, 0.0, true, report});
}

// All pairs over a span; later than the first contact that is known nothing is searched.
void PathSearch::search_span(const PathSpan& span) {
  place_all(span);
  met_.clear();
  for (int64_t k = 0; k < scene_.pair_count; ++k) {
    if (!may_meet(scene_.pairs[k])) continue;
    const Touch met = touch(scene_.pairs[k], span);
    if (met.toi == kNever) continue;
    if (met.toi == 0.0 && span.segment == 0 && span.begin == 0.0 && starts_with_contact(span.path, k)) return;
    met_.emplace_back(k, met);
  }
  std::stable_sort(met_.begin(), met_.end(), [](const auto& a, const auto& b) { return a.second.toi < b.second.toi; });
  for (const auto& [pair, met] : met_) search_pair(pair, span, met);
}

// What follows the contact of a pair over a span, part by part.
void PathSearch::search_pair(int64_t pair, const PathSpan& span, const Touch& met) {
  open_.clear();
  const auto go_on = [&](const PathSpan& within, const Touch& touched) {
    const double at = time_of_contact(within, touched.toi);
    if (is_fine(within, touched.stray, resolution_)) return record(pair, within, at, touched);
    const int parts = parts_of_rest(within, at, touched.stray, resolution_);
    for (int k = parts - 1; k >= 0; --k) {
      open_.push_back({edge_of_part(at, within.end, k, parts), edge_of_part(at, within.end, k + 1, parts)});
    }
  };
  go_on(span, met);
  while (!open_.empty()) {
    const PathSpan part{span.path, span.segment, open_.back().begin, open_.back().end};
    open_.pop_back();
    if (!verdict_.first.is_after(part.segment, part.begin)) return;
    const Touch touched = touch(scene_.pairs[pair], part);
    if (touched.toi < kNever) go_on(part, touched);
  }
}

void PathSearch::record(int64_t pair, const PathSpan& span, double at, const Touch& met) {
  FirstContact& first = verdict_.first;
  const bool is_equal = first.segment == span.segment && first.toi == at;
  if (!first.is_after(span.segment, at) && !(is_equal && pair < first.pair)) return;
  first = {span.segment, at, pair};
  verdict_.verdict = Verdict::kNear;
  verdict_.point = point_of(scene_.pairs[pair], span, met.contact);
}

bool PathSearch::starts_with_contact(int64_t path, int64_t pair) {
  const PathSpan start{path, 0, 0.0, 0.0};
  const std::optional<PairContact> contact = contact_at_rest(scene_.pairs[pair], start, Report::kFirst);
  if (!contact) return false;
  verdict_.verdict = Verdict::kStart;
  verdict_.first = {0, 0.0, pair};
  verdict_.point = point_of(scene_.pairs[pair], start, *contact);
  return true;
}

// The point of a contact in the world.
Vec3<double> PathSearch::point_of(const ArmPair& pair, const PathSpan& span, const PairContact& contact) {
  double stray;
  place_pair(pair, span, stray);
  const RigidBodies bodies = columns_of(pair_).bodies(scene_.meshes, 2);
  const Vec3<double> point = place_of_contact(bodies, 0, 1, contact).point;
  if (pair.shared == 0) return point;
  PathSpan then = span;
  then.begin = then.end = span.begin + contact.outcome.toi * (span.end - span.begin);
  const ArmSpan at = joints_over(paths_, scene_.arm, then);
  const JointChain chain = chain_of(scene_.arm, pair.first, 0, joints_.data());
  for (int32_t n = 0; n < pair.shared; ++n) place_joint(scene_.arm, at, chain, n);
  const RigidPose& frame = chain.motion(pair.shared - 1).begin;
  return frame.position + rotated(frame.orientation, point);
}

// The k-th configuration in which bodies are looked at behind a contact; denser near the contact.
PathSpan PathSearch::witness(int k) const {
  const FirstContact& first = verdict_.first;
  if (k == kWitnesses - 1) return {path_, std::min(first.segment + 1, paths_.waypoint_count - 2), 1.0, 1.0};
  const double s = first.toi + (1.0 - first.toi) * (k == 0 ? 0.0 : std::ldexp(1.0, k + 2 - kWitnesses));
  return {path_, first.segment, s, s};
}

// Whether bodies touch in one of these configurations: those that came near, which mostly do, or others.
bool PathSearch::touch_behind() {
  const auto touches = [&](int64_t pair, int k) {
    return contact_at_rest(scene_.pairs[pair], witness(k), Report::kAny).has_value();
  };
  const int64_t near = verdict_.first.pair;
  for (int k = 0; k < kWitnesses; ++k) {
    if (touches(near, k)) return true;
  }
  for (int k = 0; k < kWitnesses; ++k) {
    place_all(witness(k));
    for (int64_t pair = 0; pair < scene_.pair_count; ++pair) {
      if (pair != near && may_meet(scene_.pairs[pair]) && touches(pair, k)) return true;
    }
  }
  return false;
}

PathVerdict PathSearch::certify(const ArmPaths& paths, int64_t path, bool tells_collisions) {
  paths_ = paths;
  path_ = path;
  one_pair_.node_tests = one_pair_.candidates = 0;
  verdict_ = {Verdict::kFree, {paths.waypoint_count, kNever, -1}, {NAN, NAN, NAN}, {}};
  if (!is_sound_path(scene_, paths, path)) {
    verdict_.verdict = Verdict::kInvalid;
    verdict_.first = {-1, 0.0, -1};
    return verdict_;
  }
  for (int64_t segment = 0; segment + 1 < paths.waypoint_count; ++segment) {
    const PathSpan whole{path, segment, 0.0, 1.0};
    const int64_t parts = first_parts(scene_.arm, joints_over(paths, scene_.arm, whole));
    for (int64_t k = 0; k < parts; ++k) {
      const double begin = edge_of_part(0.0, 1.0, k, parts);
      if (verdict_.verdict == Verdict::kStart || !verdict_.first.is_after(segment, begin)) break;
      search_span({path, segment, begin, edge_of_part(0.0, 1.0, k + 1, parts)});
    }
  }
  if (verdict_.verdict == Verdict::kFree) verdict_.first.segment = -1;
  if (verdict_.verdict == Verdict::kNear && tells_collisions && touch_behind()) verdict_.verdict = Verdict::kCollision;
  verdict_.counts[kArmNodeTests] = one_pair_.node_tests;
  verdict_.counts[kArmCandidates] = one_pair_.candidates;
  return verdict_;
}

void certify(const Executor& executor, const ArmScene& scene, const ArmPaths& paths, double resolution,
             const PathVerdicts& out) {
  parallel_chunks(executor, paths.path_count, std::max<int64_t>(1, paths.path_count / (16 * executor.worker_count())),
                  [&](int, int64_t begin, int64_t end) {
                    PathSearch search(scene, resolution);
                    for (int64_t path = begin; path < end; ++path) {
                      const PathVerdict found = search.certify(paths, path, true);
                      out.verdict[path] = static_cast<int8_t>(found.verdict);
                      out.segment[path] = found.first.segment;
                      out.toi[path] = found.first.toi;
                      const ArmPair none{-1, -1, 0};
                      const ArmPair& pair = found.first.pair < 0 ? none : scene.pairs[found.first.pair];
                      out.bodies[2 * path] = pair.first;
                      out.bodies[2 * path + 1] = pair.second;
                      store_vec3(out.point + 3 * path, found.point);
                      std::copy_n(found.counts, int64_t{kArmCounts}, out.counts + kArmCounts * path);
                    }
                  });
}

}  // namespace pgccd
