// The search of one path after another, by a team of threads: one on the host, a warp on a device. All threads of a
// team follow the same way through it; `Team` says how they share loops, and tests a pair of bodies.
#pragma once

#include "kernels/arms/search_memory.h"
#include "kernels/narrow/contact_item.h"

namespace pgccd {

template <class Team>
class PathSearch {
 public:
  PGCCD_TARGET PathSearch(const ArmScene& scene, const ArmPaths& paths, double resolution, const SearchMemory& memory,
                          Team& team)
      : scene_(scene), paths_(paths), resolution_(resolution), memory_(memory), team_(team) {
    const int64_t count = scene.arm.body_count + scene.obstacles.count;
    spheres_.count = count;
    spheres_.centres = {memory.centres, memory.centres + 3 * count, memory.centres + 6 * count, count};
    spheres_.tolerance = kContactTolerance * resolution;
  }

  PGCCD_TARGET PathVerdict certify(int64_t path, const SearchOptions& options) {
    const double nan = static_cast<double>(NAN);
    path_ = path;
    options_ = options;
    verdict_ = {Verdict::kFree, {paths_.segment_count(), static_cast<double>(INFINITY), -1}, {nan, nan, nan}, {}};
    team_.begin();
    if (!is_sound()) {
      verdict_.verdict = Verdict::kInvalid;
      verdict_.first = {-1, 0.0, -1};
      return verdict_;
    }
    if (options.first_pair >= 0) {
      for_each_span([&](const PathSpan& span) { search_first(options.first_pair, span); });
    }
    for_each_span([&](const PathSpan& span) { search_span(span); });
    if (verdict_.verdict == Verdict::kFree) verdict_.first.segment = -1;
    if (verdict_.verdict == Verdict::kNear && options.tells_collisions && touch_behind())
      verdict_.verdict = Verdict::kCollision;
    verdict_.counts[kArmNodeTests] = team_.node_tests();
    verdict_.counts[kArmCandidates] = team_.candidates();
    if (team_.is_exhausted()) {
      verdict_.verdict = Verdict::kUndecided;
      verdict_.first = {-1, 0.0, -1};
      verdict_.point = {nan, nan, nan};
    }
    return verdict_;
  }

  // A pair that touches at the first waypoint of a path, `first_pair` if it does.
  PGCCD_TARGET int64_t find_touching(int64_t path, int64_t first_pair) {
    path_ = path;
    team_.begin();
    if (!is_sound()) return kNoPose;
    const PathSpan still{path, 0, 0.0, 0.0};
    if (first_pair >= 0 && contact_at_rest(first_pair, still, true).is_found()) return first_pair;
    return find_touching_at(still, first_pair);
  }

 private:
  PGCCD_TARGET bool is_decided() const { return verdict_.first.pair >= 0 || team_.is_exhausted(); }

  // Calls search(span) for the parts into which the segments are split first, until a contact is known.
  template <class Search>
  PGCCD_TARGET void for_each_span(Search&& search) {
    for (int64_t segment = 0; segment < paths_.segment_count(); ++segment) {
      const int64_t parts = first_parts(scene_.arm, curve_of(paths_, scene_.arm, path_, segment));
      for (int64_t k = 0; k < parts; ++k) {
        if (is_decided()) return;
        search({path_, segment, edge_of_part(0.0, 1.0, k, parts), edge_of_part(0.0, 1.0, k + 1, parts)});
      }
    }
  }

  PGCCD_TARGET_RARE bool is_sound() {
    bool is_wrong = team_.index() == 0 && !are_sound_obstacles(scene_.obstacles, path_);
    for (int64_t k = team_.index(); k < paths_.control_count; k += Team::kCount) {
      is_wrong |= !is_sound_control(scene_.arm, paths_, path_, k);
    }
    return !team_.any(is_wrong);
  }

  // All bodies, and the spheres that contain them, over a span.
  PGCCD_TARGET_RARE void place_all(const PathSpan& span) {
    ++verdict_.counts[kSpans];
    const Arm& arm = scene_.arm;
    const int64_t count = spheres_.count;
    const RigidBodies bodies = memory_.rows.bodies(scene_.meshes, count);
    const bool rests = span.begin == span.end;
    if constexpr (Team::kCount == 1) {
      for (int64_t k = 0; k < arm.joint_count; ++k) memory_.is_placed[k] = 0;
    }
    team_.sync();
    for (int64_t body = team_.index(); body < count; body += Team::kCount) {
      memory_.rows.store(body, arc_of(body, 0, span, rests, Team::kCount == 1), scene_, body);
      const MovingSphere sphere = moving_sphere(bodies, body);
      const double reach = add_up(sphere.reach, memory_.rows.margin[body]);
      store_vec3(memory_.centres + 3 * body, sphere.centre_t0);
      store_vec3(memory_.centres + 3 * (count + body), sphere.centre_t1);
      memory_.centres[6 * count + body] = reach;
      const Vec3<double> half = 0.5 * (sphere.centre_t1 - sphere.centre_t0);
      memory_.balls[body] = {sphere.centre_t0 + half, reach + norm(half)};
    }
    team_.sync();
  }

  // `is_shared`: joints that are placed are not placed again.
  PGCCD_TARGET_RARE ArmArc arc_of(int64_t body, int32_t shared, const PathSpan& span, bool rests, bool is_shared) {
    const Arm& arm = scene_.arm;
    if (body >= arm.body_count) {
      return arc_of_obstacle(scene_.obstacles, body - arm.body_count, span.path, span.segment, span.begin, span.end);
    }
    const JointChain chain = chain_of(arm, body, shared, memory_.joints);
    const ArmSpan over = joints_over(paths_, arm, span);
    for (int32_t n = 0; n < chain.count; ++n) {
      if (is_shared) {
        if (memory_.is_placed[chain.frames[n]]) continue;
        memory_.is_placed[chain.frames[n]] = 1;
      }
      place_joint(arm, over, chain, n);
    }
    return arc_of_body(arm, chain, rests, arm.body_reach[body]);
  }

  // By the spheres of two bodies; first by balls around their whole ways, which reject most pairs.
  PGCCD_TARGET bool may_meet(const ArmPair& pair) const {
    return pgccd::may_meet(memory_.balls[pair.first], memory_.balls[pair.second], spheres_.tolerance) &&
           spheres_may_meet(spheres_, pair.first, pair.second);
  }

  PGCCD_TARGET RigidBodies two_bodies() const { return team_.pair().columns().bodies(scene_.meshes, 2); }

  // The two bodies of a pair in its frame; returns their strays, added.
  PGCCD_TARGET_RARE double place_pair(const ArmPair& pair, const PathSpan& span) {
    PairMemory& memory = team_.pair();
    team_.sync();
    for (int side = team_.index(); side < 2; side += Team::kCount) {
      const int32_t body = side == 0 ? pair.first : pair.second;
      const ArmArc arc = arc_of(body, pair.shared, span, span.begin == span.end, false);
      memory.columns().store(side, arc, scene_, body);
      memory.stray[side] = arc.stray;
    }
    team_.sync();
    return memory.stray[0] + memory.stray[1];
  }

  // Whether the two bodies may come within the tolerance: by their spheres and boxes.
  PGCCD_TARGET_RARE bool may_touch(const RigidBodies& bodies, double tolerance) {
    PairMemory& memory = team_.pair();
    BroadBodies broad{};
    broad.count = 2;
    broad.centres = {memory.centres, memory.centres + 6, memory.reach, 2};
    broad.tolerance = tolerance;
    broad.boxes = memory.boxes;
    for (int side = team_.index(); side < 2; side += Team::kCount) {
      const MovingSphere sphere = moving_sphere(bodies, side);
      store_vec3(memory.centres + 3 * side, sphere.centre_t0);
      store_vec3(memory.centres + 6 + 3 * side, sphere.centre_t1);
      memory.reach[side] = add_up(sphere.reach, bodies.centres.margin[side]);
    }
    team_.sync();
    if (!spheres_may_meet(broad, 0, 1)) return false;
    if (bodies.meshes.boxes == nullptr) return true;
    for (int side = team_.index(); side < 2; side += Team::kCount) {
      memory.boxes[side] = moving_box(SingleThread{}, bodies, side);
    }
    team_.sync();
    if (!memory.boxes[0].is_slender() && !memory.boxes[1].is_slender()) return true;
    const BoxPair boxes(broad, 0, 1);
    bool are_apart = false;
    for (int k = team_.index(); k < boxes.direction_count() && !are_apart; k += Team::kCount) {
      are_apart = boxes.separates(k);
    }
    return !team_.any(are_apart);
  }

  PGCCD_TARGET_RARE PairTouch touch(int64_t pair, const PathSpan& span) {
    if (verdict_.counts[kPairSpans] >= options_.budget) team_.give_up();
    if (team_.is_exhausted()) return {static_cast<double>(INFINITY), 0.0, {}};
    ++verdict_.counts[kPairSpans];
    PairTouch touch{static_cast<double>(INFINITY), place_pair(scene_.pairs[pair], span), {}};
    const RigidBodies bodies = two_bodies();
    const double tolerance = kContactTolerance * resolution_;
    if (team_.is_known_apart(pair, bodies) || !may_touch(bodies, tolerance)) return touch;
    // Bodies that are apart at the start of a path are so at the start of every later span, unless one before it is not
    // free.
    const PairQuery query{tolerance, span.segment == 0 && span.begin == 0.0, false};
    if (!is_fine(span, touch.stray, resolution_)) {
      touch.toi = team_.free_until(bodies, query);
    } else {
      touch.contact = team_.contact(bodies, query);
      touch.toi = touch.contact.outcome.toi;
    }
    if (touch.toi == static_cast<double>(INFINITY)) team_.learn(pair, bodies);
    return touch;
  }

  PGCCD_TARGET_RARE PairContact contact_at_rest(int64_t pair, const PathSpan& still, bool any_will_do) {
    ++verdict_.counts[kPairSpans];
    place_pair(scene_.pairs[pair], still);
    const RigidBodies bodies = two_bodies();
    if (!may_touch(bodies, 0.0)) return {};
    return team_.contact(bodies, {0.0, true, any_will_do});
  }

  // A pair over a span; false if it is free, or touches at the start of the path.
  PGCCD_TARGET bool meets(int64_t pair, const PathSpan& span, PairTouch& met) {
    met = touch(pair, span);
    if (met.toi == static_cast<double>(INFINITY)) return false;
    return !(span.segment == 0 && span.begin == 0.0 && met.toi == 0.0 && starts_with_contact(pair));
  }

  PGCCD_TARGET void search_first(int64_t pair, const PathSpan& span) {
    PairTouch met;
    if (meets(pair, span, met)) search_pair(pair, span, met);
  }

  // All pairs over a span; first all of it, then what follows contacts, the earliest of them first.
  PGCCD_TARGET_RARE void search_span(const PathSpan& span) {
    place_all(span);
    int64_t count = 0;
    team_.for_each_where(
        scene_.pair_count, [&](int64_t k) { return k != options_.first_pair && may_meet(scene_.pairs[k]); },
        [&](int64_t k) {
          PairTouch met;
          if (is_decided() || !meets(k, span, met)) return;
          if (options_.any_will_do) return search_pair(k, span, met);
          if (team_.index() == 0) memory_.met[count] = {k, met};
          ++count;
        });
    if (is_decided()) return;
    team_.sync();
    for (int64_t searched = 0; searched < count; ++searched) {
      int64_t next = -1;
      for (int64_t k = 0; k < count; ++k) {
        const MetPair& met = memory_.met[k];
        if (met.pair >= 0 && (next < 0 || met.touch.toi < memory_.met[next].touch.toi)) next = k;
      }
      const MetPair met = memory_.met[next];
      team_.sync();
      if (team_.index() == 0) memory_.met[next].pair = -1;
      search_pair(met.pair, span, met.touch);
    }
  }

  // What follows the contact of a pair over a span, part by part.
  PGCCD_TARGET_RARE void search_pair(int64_t pair, const PathSpan& span, const PairTouch& first) {
    PathSpan within = span;
    PairTouch met = first;
    int open = 0;
    for (;;) {
      if (met.toi < static_cast<double>(INFINITY)) {
        const double at = time_of_contact(within, met.toi);
        if (is_fine(within, met.stray, resolution_)) {
          record(pair, within, at, met);
        } else {
          const int parts = parts_of_rest(within, at, met.stray, resolution_);
          for (int k = team_.index(); k < parts; k += Team::kCount) {
            memory_.open[open + parts - 1 - k] = {edge_of_part(at, within.end, k, parts),
                                                  edge_of_part(at, within.end, k + 1, parts)};
          }
          open += parts;
        }
      }
      team_.sync();
      if (open == 0) return;
      const OpenSpan next = memory_.open[--open];
      within.begin = next.begin;
      within.end = next.end;
      if (!verdict_.first.is_after(within.segment, within.begin)) return;
      met = touch(pair, within);
    }
  }

  PGCCD_TARGET void record(int64_t pair, const PathSpan& span, double at, const PairTouch& met) {
    FirstContact& first = verdict_.first;
    const bool is_equal = first.segment == span.segment && first.toi == at;
    if (!first.is_after(span.segment, at) && !(is_equal && pair < first.pair)) return;
    first = {span.segment, at, pair};
    verdict_.verdict = Verdict::kNear;
    verdict_.point = point_of(scene_.pairs[pair], span, met.contact);
  }

  PGCCD_TARGET_RARE bool starts_with_contact(int64_t pair) {
    const PathSpan start{path_, 0, 0.0, 0.0};
    const PairContact contact = contact_at_rest(pair, start, false);
    if (!contact.is_found()) return false;
    verdict_.verdict = Verdict::kStart;
    verdict_.first = {0, 0.0, pair};
    verdict_.point = point_of(scene_.pairs[pair], start, contact);
    return true;
  }

  // The point of a contact in the world.
  PGCCD_TARGET_RARE Vec3<double> point_of(const ArmPair& pair, const PathSpan& span, const PairContact& contact) {
    place_pair(pair, span);
    if (team_.index() == 0) store_vec3(team_.pair().point, point_by_one(pair, span, contact));
    team_.sync();
    return load_vec3(team_.pair().point);
  }
  PGCCD_TARGET Vec3<double> point_by_one(const ArmPair& pair, const PathSpan& span, const PairContact& contact) {
    const RigidBodies bodies = two_bodies();
    const PairOf<RigidBodies> both(bodies, 0, 1);
    const Vec3<double> point = contact_place(bodies, both, contact.candidate, contact.outcome.toi).point;
    if (pair.shared == 0) return point;
    PathSpan then = span;
    then.begin = then.end = span.begin + contact.outcome.toi * (span.end - span.begin);
    const ArmSpan at = joints_over(paths_, scene_.arm, then);
    const JointChain chain = chain_of(scene_.arm, pair.first, 0, memory_.joints);
    for (int32_t n = 0; n < pair.shared; ++n) place_joint(scene_.arm, at, chain, n);
    const RigidPose& frame = chain.motion(pair.shared - 1).begin;
    return frame.position + rotated(frame.orientation, point);
  }

  // Configurations behind a contact in which bodies are looked at; denser near the contact.
  static constexpr int kWitnesses = 16;
  PGCCD_TARGET PathSpan witness(int k) const {
    const FirstContact& first = verdict_.first;
    if (k == kWitnesses - 1) {
      return {path_, smaller(first.segment + 1, paths_.segment_count() - 1), 1.0, 1.0};
    }
    const double s = first.toi + (1.0 - first.toi) * (k == 0 ? 0.0 : std::ldexp(1.0, k + 2 - kWitnesses));
    return {path_, first.segment, s, s};
  }

  // Whether bodies touch in one of these configurations: those that came near, which mostly do, or others.
  PGCCD_TARGET bool touch_behind() {
    const int64_t near = verdict_.first.pair;
    // In an order that soon has some well behind the contact.
    constexpr int kFirst = 8, kStride = 5;
    for (int k = 0; k < kWitnesses; ++k) {
      if (contact_at_rest(near, witness((kFirst + kStride * k) % kWitnesses), true).is_found()) return true;
    }
    for (int k = 0; k < kWitnesses; ++k) {
      if (find_touching_at(witness(k), near) != kNoPair) return true;
    }
    return false;
  }

  // A pair that touches in a configuration, besides one.
  PGCCD_TARGET_RARE int64_t find_touching_at(const PathSpan& still, int64_t besides) {
    place_all(still);
    int64_t found = kNoPair;
    team_.for_each_where(
        scene_.pair_count, [&](int64_t pair) { return pair != besides && may_meet(scene_.pairs[pair]); },
        [&](int64_t pair) {
          if (found == kNoPair && contact_at_rest(pair, still, true).is_found()) found = pair;
        });
    return found;
  }

  const ArmScene& scene_;
  const ArmPaths& paths_;
  double resolution_;
  SearchMemory memory_;
  Team& team_;
  BroadBodies spheres_{};
  int64_t path_ = 0;
  SearchOptions options_{};
  PathVerdict verdict_{};
};

}  // namespace pgccd
