// The operators of the rounds in which collisions are resolved, templates over the session that they run in.
#pragma once

#include "bind/detect_ops.h"
#include "kernels/resolve/resolve.h"

namespace pgccd::bind {

// Of rigid bodies, as of `rigid_view`.
inline PairBodies pair_bodies(const TensorList& t, const char* name) {
  STD_TORCH_CHECK(t.size() == 6 || t.size() == 7, name, ": expected 6 or 7 tensors, got ", t.size());
  PairBodies view;
  view.mesh_index = rows<int32_t>(t[0], name, {kAnySize});
  const int64_t count = view.centres.count = t[0].size(0);
  view.centres.position_t0 = rows<double>(t[1], name, {count, 3});
  view.centres.position_t1 = rows<double>(t[2], name, {count, 3});
  view.centres.radius = rows<double>(t[3], name, {count});
  view.orientation = rows<double>(t[4], name, {count, 4});
  view.rotation = rows<double>(t[5], name, {count, 3});
  if (t.size() == 7) view.centres.margin = rows<double>(t[6], name, {count});
  return view;
}

template <class Session>
struct ResolveOps {
  static void resolve_slow_down(Tensor first, Tensor fraction, Tensor changed, Tensor changes, double approach,
                                double smallest) {
    rows<double>(first, "first", {kAnySize});
    const int64_t count = first.size(0);
    rows<double>(fraction, "fraction", {count});
    rows<uint8_t>(changed, "changed", {count});
    rows<int64_t>(changes, "changes", {1});
    pgccd::slow_all_down(
        Session(first).context(),
        {data<double>(first), data<double>(fraction), data<uint8_t>(changed), count, approach, smallest},
        data<int64_t>(changes));
  }

  static void resolve_first_toi(Tensor first, const Tensor& pairs, const Tensor& toi) {
    rows<double>(first, "first", {kAnySize});
    FirstToiInput input;
    input.toi = rows<double>(toi, "toi", {kAnySize});
    input.count = toi.size(0);
    input.pairs = rows<int64_t>(pairs, "pairs", {input.count, 2});
    input.body_count = first.size(0);
    pgccd::lower_first_toi_of_bodies(Session(first).context(), input, data<double>(first));
  }

  // Pairs, the `MovingBodies.tensors` of their bodies, counts.
  static std::tuple<Tensor, std::vector<Tensor>, Tensor> resolve_pairs(const TensorList& own, const TensorList& ghosts,
                                                                       const Tensor& fraction, const Tensor& changed,
                                                                       const Tensor& pairs, bool skips_equal,
                                                                       bool by_velocity, int64_t capacity) {
    STD_TORCH_CHECK(capacity >= 0 && capacity < (int64_t{1} << 31), "capacity: expected a number in [0, 2^31), got ",
                    capacity);
    STD_TORCH_CHECK(own.size() == ghosts.size(), "ghosts: expected ", own.size(), " tensors, got ", ghosts.size());
    ShortenedPairs given;
    given.own = pair_bodies(own, "own");
    given.ghosts = pair_bodies(ghosts, "ghosts");
    const int64_t held = given.own.centres.count + given.ghosts.centres.count;
    given.fraction = rows<double>(fraction, "fraction", {held});
    given.changed = {rows<int64_t>(pairs, "pairs", {kAnySize, 2}), rows<uint8_t>(changed, "changed", {held}),
                     given.fraction, held, skips_equal};
    given.by_velocity = by_velocity;
    given.pair_count = pairs.size(0);
    STD_TORCH_CHECK(given.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
    Tensor found = new_tensor<int64_t>(pairs, {capacity, 2}), counts = new_tensor<int64_t>(pairs, {kPairCounts});
    const auto column = [&](int64_t width) { return new_tensor<double>(fraction, {2 * capacity, width}); };
    Tensor mesh_index = new_tensor<int32_t>(fraction, {2 * capacity});
    Tensor radius = new_tensor<double>(fraction, {2 * capacity}), position_t0 = column(3), position_t1 = column(3);
    Tensor orientation = column(4), rotation = column(3);
    std::vector<Tensor> bodies{mesh_index, position_t0, position_t1, radius, orientation, rotation};
    given.motion = {data<int32_t>(mesh_index),
                    data<double>(position_t0),
                    data<double>(position_t1),
                    data<double>(radius),
                    data<double>(orientation),
                    data<double>(rotation),
                    nullptr};
    if (given.own.centres.margin != nullptr) {
      bodies.push_back(new_tensor<double>(fraction, {2 * capacity}));
      given.motion.margin = data<double>(bodies.back());
    }
    given.capacity = capacity;
    given.pairs = data<int64_t>(found);
    given.counts = data<int64_t>(counts);
    pgccd::shortened_pairs(Session(fraction).context(), given);
    return {found, bodies, counts};
  }
};

template <class Session>
void register_resolve_ops(Library& library) {
  using Ops = ResolveOps<Session>;
  library.impl("resolve_slow_down", PGCCD_BOX(Ops::resolve_slow_down));
  library.impl("resolve_first_toi", PGCCD_BOX(Ops::resolve_first_toi));
  library.impl("resolve_pairs", PGCCD_BOX(Ops::resolve_pairs));
}

}  // namespace pgccd::bind
