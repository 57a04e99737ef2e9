// The operators of the nanorobot simulation, written once for both backends.
#pragma once

#include "bind/detect_ops.h"
#include "bind/simulate_arguments.h"

namespace pgccd::bind {

using IntegerList = std::vector<int64_t>;
using ScaleList = std::vector<double>;

inline Tensor new_rows(const Tensor& like, int64_t count, int64_t width) {
  return torch::stable::new_empty(like, {count, width}, ScalarType::Double);
}

inline Tensor new_integers(const Tensor& like, int64_t count) {
  return torch::stable::new_empty(like, {count}, ScalarType::Long);
}

template <class Backend>
struct SimulateOps {
  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> simulate_start(const Tensor& id,
                                                                                   IntegerList integers,
                                                                                   ScaleList scales) {
    const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
    const int64_t count = id.size(0);
    Tensor position = new_rows(id, count, 3), orientation = new_rows(id, count, 4);
    Tensor velocity = new_rows(id, count, 3), angular_velocity = new_rows(id, count, 3);
    Tensor target = new_integers(id, count), stay_until = new_integers(id, count);
    Backend(id).start(world_view(integers, scales), ids, count,
                      {data<double>(position), data<double>(orientation), data<double>(velocity),
                       data<double>(angular_velocity), data<int64_t>(target), data<int64_t>(stay_until)});
    return {position, orientation, velocity, angular_velocity, target, stay_until};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> simulate_plan(const TensorList& state, const Tensor& step,
                                                                  IntegerList integers, ScaleList scales) {
    const RobotColumns robots = robot_columns(state);
    const int64_t* index = rows<int64_t>(step, "step", {1});
    Tensor velocity = new_rows(state[0], robots.count, 3), angular_velocity = new_rows(state[0], robots.count, 3);
    Tensor target = new_integers(state[0], robots.count), stay_until = new_integers(state[0], robots.count);
    RobotResults results;
    results.velocity = data<double>(velocity);
    results.angular_velocity = data<double>(angular_velocity);
    results.target = data<int64_t>(target);
    results.stay_until = data<int64_t>(stay_until);
    Backend(state[0]).plan(world_view(integers, scales), robots, index, results);
    return {velocity, angular_velocity, target, stay_until};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> simulate_respond(const TensorList& state, const Tensor& fraction) {
    const RobotColumns robots = robot_columns(state);
    const double* made = rows<double>(fraction, "fraction", {robots.count});
    Tensor position = new_rows(fraction, robots.count, 3), orientation = new_rows(fraction, robots.count, 4);
    Tensor velocity = new_rows(fraction, robots.count, 3), angular_velocity = new_rows(fraction, robots.count, 3);
    RobotResults results;
    results.position = data<double>(position);
    results.orientation = data<double>(orientation);
    results.velocity = data<double>(velocity);
    results.angular_velocity = data<double>(angular_velocity);
    Backend(fraction).respond(robots, made, results);
    return {position, orientation, velocity, angular_velocity};
  }

  // Applies the planned step in place, unless `discard` is nonzero.
  static void simulate_commit(const TensorList& state, const TensorList& planned, const Tensor& fraction,
                              const Tensor& discard) {
    RobotColumns robots = robot_columns(state);
    RobotResults results;
    results.position = const_cast<double*>(robots.position);
    results.orientation = const_cast<double*>(robots.orientation);
    results.velocity = const_cast<double*>(robots.velocity);
    results.angular_velocity = const_cast<double*>(robots.angular_velocity);
    results.target = const_cast<int64_t*>(robots.target);
    results.stay_until = const_cast<int64_t*>(robots.stay_until);
    STD_TORCH_CHECK(planned.size() == 4, "planned: expected 4 tensors, got ", planned.size());
    robots.velocity = rows<double>(planned[0], "planned.velocity", {robots.count, 3});
    robots.angular_velocity = rows<double>(planned[1], "planned.angular_velocity", {robots.count, 3});
    robots.target = rows<int64_t>(planned[2], "planned.target", {robots.count});
    robots.stay_until = rows<int64_t>(planned[3], "planned.stay_until", {robots.count});
    Backend(fraction).commit(robots, rows<double>(fraction, "fraction", {robots.count}),
                             rows<int64_t>(discard, "discard", {1}), results);
  }

  static void simulate_slow_all_down(Tensor first, Tensor fraction, Tensor changed, Tensor changes, double approach,
                                     double smallest) {
    rows<double>(first, "first", {kAnySize});
    const int64_t count = first.size(0);
    rows<double>(fraction, "fraction", {count});
    rows<uint8_t>(changed, "changed", {count});
    rows<int64_t>(changes, "changes", {1});
    Backend(first).slow_all_down(
        {data<double>(first), data<double>(fraction), data<uint8_t>(changed), count, approach, smallest},
        data<int64_t>(changes));
  }

  static void simulate_first_toi(Tensor first, const std::optional<Tensor>& robots, const Tensor& pairs,
                                 const Tensor& toi) {
    rows<double>(first, "first", {kAnySize});
    FirstToiInput input;
    input.robots = robots ? rows<int64_t>(*robots, "robots", {kAnySize}) : nullptr;
    input.toi = rows<double>(toi, "toi", {kAnySize});
    input.count = toi.size(0);
    input.pairs = rows<int64_t>(pairs, "pairs", {input.count, 2});
    input.robot_count = first.size(0);
    input.copy_count = robots ? robots->size(0) : input.robot_count;
    Backend(first).first_toi(input, data<double>(first));
  }

  // Pairs, the `MovingBodies.tensors` of their robots, counts.
  using PairsAndMotion = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static PairsAndMotion simulate_affected_motion(const TensorList& own, const TensorList& ghosts,
                                                 const Tensor& fraction, const Tensor& changed, const Tensor& pairs,
                                                 const Tensor& mesh_radius, int64_t capacity) {
    STD_TORCH_CHECK(capacity >= 0 && capacity < (int64_t{1} << 31), "capacity: expected a number in [0, 2^31), got ",
                    capacity);
    AffectedMotion given;
    given.own = moving_robots(own, "own");
    given.ghosts = moving_robots(ghosts, "ghosts");
    const int64_t held = given.own.count + given.ghosts.count;
    given.fraction = rows<double>(fraction, "fraction", {held});
    given.affected = {rows<int64_t>(pairs, "pairs", {kAnySize, 2}), rows<uint8_t>(changed, "changed", {held}), held};
    given.pair_count = pairs.size(0);
    STD_TORCH_CHECK(given.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
    given.mesh_radius = rows<double>(mesh_radius, "mesh_radius", {kAnySize});
    given.mesh_count = mesh_radius.size(0);
    STD_TORCH_CHECK(given.mesh_count > 0, "mesh_radius: expected at least one mesh");
    Tensor found = new_tensor<int64_t>(pairs, {capacity, 2}), counts = new_integers(pairs, int64_t{kPairCounts});
    Tensor mesh_index = new_tensor<int32_t>(fraction, {2 * capacity}),
           radius = new_tensor<double>(fraction, {2 * capacity});
    Tensor position_t0 = new_rows(fraction, 2 * capacity, 3), position_t1 = new_rows(fraction, 2 * capacity, 3);
    Tensor orientation = new_rows(fraction, 2 * capacity, 4), rotation = new_rows(fraction, 2 * capacity, 3);
    given.capacity = capacity;
    given.pairs = data<int64_t>(found);
    given.motion = {data<int32_t>(mesh_index), data<double>(position_t0), data<double>(radius),
                    data<double>(orientation), data<double>(position_t1), data<double>(rotation)};
    given.counts = data<int64_t>(counts);
    Backend(fraction).affected_motion(given);
    return {found, mesh_index, position_t0, position_t1, radius, orientation, rotation, counts};
  }

  static Tensor simulate_tally(const TensorList& state, const Tensor& fraction, const Tensor& id, const Tensor& pairs,
                               const Tensor& toi) {
    StepOutcome outcome;
    outcome.state = hash_columns(state);
    outcome.fraction = rows<double>(fraction, "fraction", {outcome.state.count});
    outcome.toi = rows<double>(toi, "toi", {kAnySize});
    outcome.contact_count = toi.size(0);
    outcome.id = rows<int64_t>(id, "id", {kAnySize});
    outcome.id_count = id.size(0);
    outcome.pairs = rows<int64_t>(pairs, "pairs", {outcome.contact_count, 2});
    Tensor tally = new_integers(fraction, kTallyCounts);
    Backend(fraction).tally_step(outcome, reinterpret_cast<StepTally*>(data<int64_t>(tally)));
    return tally;
  }

  static Tensor simulate_hash(const TensorList& columns) {
    const HashColumns views = hash_columns(columns);
    Tensor sum = new_integers(columns[0], 1);
    Backend(sum).hash_rows(views, data<uint64_t>(sum));
    return sum;
  }

  static Tensor random_uniforms(const Tensor& id, int64_t seed, int64_t step, int64_t stream) {
    const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
    const int64_t count = id.size(0);
    Tensor uniforms = new_rows(id, count, 4);
    Backend(id).random_uniforms(static_cast<uint64_t>(seed), ids, count, counter_word(step, "step"),
                                counter_word(stream, "stream"), data<double>(uniforms));
    return uniforms;
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_SIMULATE_OPS(library, Backend)                                                           \
  library.impl("simulate_start", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_start>::call));         \
  library.impl("simulate_plan", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_plan>::call));           \
  library.impl("simulate_respond", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_respond>::call));     \
  library.impl("simulate_commit", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_commit>::call));       \
  library.impl("simulate_slow_all_down",                                                                        \
               TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_slow_all_down>::call));                   \
  library.impl("simulate_first_toi", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_first_toi>::call)); \
  library.impl("simulate_affected_motion",                                                                      \
               TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_affected_motion>::call));                 \
  library.impl("simulate_tally", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_tally>::call));         \
  library.impl("simulate_hash", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::simulate_hash>::call));           \
  library.impl("random_uniforms", TORCH_BOX(&OnOneDevice<&SimulateOps<Backend>::random_uniforms>::call))

}  // namespace pgccd::bind
