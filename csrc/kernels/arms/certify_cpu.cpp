#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "kernels/arms/path_search.h"

namespace pgccd {
namespace {

constexpr double kNever = std::numeric_limits<double>::infinity();
// Configurations of a segment, behind a contact, in which bodies are looked at: denser near the contact.
constexpr int kWitnesses = 15;

// Everything on the calling thread.
class OneThread final : public Executor {
 public:
  int worker_count() const override { return 1; }
  void run(int, const std::function<void(int)>& work) const override { work(0); }
};

struct PairMemory {
  ArcRows<2> rows;
  double centres[12], reach[2];
  MovingBox boxes[2];

  ArcColumns columns() {
    return {rows.position_t0, rows.position_t1, rows.orientation, rows.rotation,
            rows.radius,      rows.margin,      rows.mesh_index};
  }
};

}  // namespace

PathSearch::PathSearch(const ArmScene& scene, double resolution) : scene_(scene), resolution_(resolution) {
  const int64_t count = scene.arm.body_count + scene.obstacles.count;
  numbers_.resize(15 * count);
  mesh_index_.resize(count);
  double* next = numbers_.data();
  const auto column = [&](int64_t width) { return std::exchange(next, next + width * count); };
  rows_ = {column(3), column(3), column(4), column(3), column(1), column(1), mesh_index_.data()};
  centres_.resize(7 * count);
  spheres_.count = count;
  spheres_.centres = {centres_.data(), centres_.data() + 3 * count, centres_.data() + 6 * count, count};
  spheres_.tolerance = kContactTolerance * resolution;
}

// All bodies, and the spheres that contain them, over a span.
void PathSearch::place_all(const PathSpan& span) {
  ++verdict_.counts[kSpans];
  const RigidBodies bodies = rows_.bodies(scene_.meshes, spheres_.count);
  const int64_t count = spheres_.count;
  double* const centres = centres_.data();
  for (int64_t body = 0; body < count; ++body) {
    rows_.store(body, arc_over(scene_, paths_, span, body, kWorld), scene_, body);
    const MovingSphere sphere = moving_sphere(bodies, body);
    store_vec3(centres + 3 * body, sphere.centre_t0);
    store_vec3(centres + 3 * (count + body), sphere.centre_t1);
    centres[6 * count + body] = add_up(sphere.reach, rows_.margin[body]);
  }
}

bool PathSearch::may_meet(const ArmPair& pair) const { return spheres_may_meet(spheres_, pair.first, pair.second); }

PathSearch::Touch PathSearch::touch(const ArmPair& pair, const PathSpan& span, Find find, double tolerance) {
  ++verdict_.counts[kPairSpans];
  PairMemory memory;
  const ArcColumns columns = memory.columns();
  const int32_t both[2] = {pair.first, pair.second};
  Touch touch;
  for (int side = 0; side < 2; ++side) {
    const ArmArc arc = arc_over(scene_, paths_, span, both[side], pair.frame);
    columns.store(side, arc, scene_, both[side]);
    touch.stray += arc.stray;
  }
  const RigidBodies bodies = columns.bodies(scene_.meshes, 2);
  BroadBodies broad{};
  broad.count = 2;
  broad.centres = {memory.centres, memory.centres + 6, memory.reach, 2};
  broad.tolerance = tolerance;
  for (int side = 0; side < 2; ++side) {
    const MovingSphere sphere = moving_sphere(bodies, side);
    store_vec3(memory.centres + 3 * side, sphere.centre_t0);
    store_vec3(memory.centres + 6 + 3 * side, sphere.centre_t1);
    memory.reach[side] = add_up(sphere.reach, memory.rows.margin[side]);
  }
  if (!spheres_may_meet(broad, 0, 1)) return touch;
  if (scene_.meshes.boxes != nullptr) {
    for (int side = 0; side < 2; ++side) memory.boxes[side] = moving_box(SingleThread{}, bodies, side);
    broad.boxes = memory.boxes;
    if (!boxes_may_meet(broad, 0, 1)) return touch;
  }
  // Bodies that are apart at the start of a path are so at the start of every later span, unless one before it found a
  // contact.
  const bool tests_start = span.segment == 0 && span.begin == 0.0 ? true : span.begin == span.end;
  const int64_t pairs[2] = {0, 1}, pair_count = 1;
  int64_t traverse_counts[kTraverseCounts] = {}, contact_counts[kContactCounts] = {};
  ContactSearch search;
  search.traversal = {pairs, 1, nullptr, {0.0, tolerance, tests_start}};
  search.narrow.pairs = pairs;
  search.narrow.pair_count = 1;
  search.narrow.settings = {0.0, tolerance, false};
  search.narrow.report = find == Find::kAny ? Report::kAny : Report::kFirst;
  search.pair_count = &pair_count;
  search.contact_capacity = {0, 1};
  search.traverse_counts = traverse_counts;
  search.contact_counts = contact_counts;
  struct Row {
    int32_t pair;
    int64_t bodies[2];
    int8_t kind;
    int32_t features[2];
    int8_t status;
    double toi, coordinates[2], point[3], normal[3];
  } row{};
  find_contacts(OneThread{}, bodies, search, [&](int64_t) {
    return ContactColumns{&row.pair,   row.bodies, &row.kind,       row.features, &row.status,
                          &row.toi, row.coordinates, row.point, row.normal};
  });
  verdict_.counts[kArmNodeTests] += traverse_counts[kNodeTests];
  verdict_.counts[kArmCandidates] += traverse_counts[kCandidatesNeeded];
  touch.found = row.toi < kNever;
  touch.toi = row.toi;
  touch.point = load_vec3(row.point);
  return touch;
}

// All pairs over a span; later than the first contact that is known nothing is searched.
void PathSearch::search_span(const PathSpan& span) {
  place_all(span);
  met_.clear();
  const double tolerance = kContactTolerance * resolution_;
  for (int64_t k = 0; k < scene_.pair_count; ++k) {
    if (!may_meet(scene_.pairs[k])) continue;
    const Touch met = touch(scene_.pairs[k], span, Find::kFirst, tolerance);
    if (!met.found) continue;
    if (met.toi == 0.0 && span.segment == 0 && span.begin == 0.0 && starts_with_contact(span, k)) return;
    met_.emplace_back(k, met);
  }
  std::stable_sort(met_.begin(), met_.end(), [](const auto& a, const auto& b) { return a.second.toi < b.second.toi; });
  for (const auto& [pair, met] : met_) search_pair(pair, span, met);
}

// What follows the contact of a pair over a span, part by part.
void PathSearch::search_pair(int64_t pair, const PathSpan& span, const Touch& met) {
  const double tolerance = kContactTolerance * resolution_;
  open_.clear();
  const auto go_on = [&](const PathSpan& within, const Touch& touched) {
    const AfterContact after = after_contact(within, touched.toi, touched.stray, resolution_);
    if (after.ends) return record(pair, within, after.at, touched);
    for (int k = after.parts - 1; k >= 0; --k) {
      open_.push_back({edge_of_part(after.at, within.end, k, after.parts),
                       edge_of_part(after.at, within.end, k + 1, after.parts)});
    }
  };
  go_on(span, met);
  while (!open_.empty()) {
    const PathSpan part{span.path, span.segment, open_.back().begin, open_.back().end};
    open_.pop_back();
    if (!verdict_.first.is_after(part.segment, part.begin)) return;
    const Touch touched = touch(scene_.pairs[pair], part, Find::kFirst, tolerance);
    if (touched.found) go_on(part, touched);
  }
}

void PathSearch::record(int64_t pair, const PathSpan& span, double at, const Touch& met) {
  FirstContact& first = verdict_.first;
  const bool is_equal = first.segment == span.segment && first.toi == at;
  if (!first.is_after(span.segment, at) && !(is_equal && pair < first.pair)) return;
  first = {span.segment, at, pair};
  verdict_.verdict = Verdict::kNear;
  verdict_.point = to_world(scene_.pairs[pair].frame, met.point, span, span.begin + met.toi * (span.end - span.begin));
}

bool PathSearch::starts_with_contact(const PathSpan& span, int64_t pair) {
  const PathSpan start{span.path, 0, 0.0, 0.0};
  const Touch at_rest = touch(scene_.pairs[pair], start, Find::kFirst, 0.0);
  if (!at_rest.found) return false;
  verdict_.verdict = Verdict::kStart;
  verdict_.first = {0, 0.0, pair};
  verdict_.point = to_world(scene_.pairs[pair].frame, at_rest.point, start, 0.0);
  return true;
}

Vec3<double> PathSearch::to_world(int32_t frame, Vec3<double> point, const PathSpan& span, double s) const {
  const ArmSpan joints = joints_over(paths_, scene_.arm, span);
  for (int32_t k = frame; k != kWorld; k = scene_.arm.joints[k].parent) {
    const RigidPose pose = joint_pose(scene_.arm.joints[k], scene_.arm.places[k], joints.value(scene_.arm, k, s));
    point = pose.position + rotated(pose.orientation, point);
  }
  return point;
}

// Whether bodies touch in one of some configurations behind a contact.
bool PathSearch::touches_near(int64_t segment, double toi) {
  for (int k = 0; k <= kWitnesses; ++k) {
    const double ahead = k == 0 ? 0.0 : std::ldexp(1.0, k + 1 - kWitnesses);
    PathSpan still{path_, segment, toi + (1.0 - toi) * ahead, 0.0};
    if (k == kWitnesses) {
      still.segment = std::min(segment + 1, paths_.waypoint_count - 2);
      still.begin = 1.0;
    }
    still.end = still.begin;
    if (any_touches(still)) return true;
  }
  return false;
}

bool PathSearch::any_touches(const PathSpan& still) {
  const int64_t near = verdict_.first.pair;
  if (touch(scene_.pairs[near], still, Find::kAny, 0.0).found) return true;
  place_all(still);
  for (int64_t k = 0; k < scene_.pair_count; ++k) {
    if (k != near && may_meet(scene_.pairs[k]) && touch(scene_.pairs[k], still, Find::kAny, 0.0).found) return true;
  }
  return false;
}

PathVerdict PathSearch::certify(const ArmPaths& paths, int64_t path, bool tells_collisions) {
  paths_ = paths;
  path_ = path;
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
  if (verdict_.verdict == Verdict::kNear && tells_collisions && touches_near(verdict_.first.segment, verdict_.first.toi))
    verdict_.verdict = Verdict::kCollision;
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
                      const ArmPair none{-1, -1, kWorld};
                      const ArmPair& pair = found.first.pair < 0 ? none : scene.pairs[found.first.pair];
                      out.bodies[2 * path] = pair.first;
                      out.bodies[2 * path + 1] = pair.second;
                      store_vec3(out.point + 3 * path, found.point);
                      std::copy_n(found.counts, int64_t{kArmCounts}, out.counts + kArmCounts * path);
                    }
                  });
}

}  // namespace pgccd
