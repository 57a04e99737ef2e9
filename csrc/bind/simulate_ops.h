// The operators of the nanorobot simulation, templates over the session that they run in.
#pragma once

#include "bind/detect_ops.h"
#include "kernels/simulate/simulate.h"

namespace pgccd::bind {

inline World world_view(const std::vector<int64_t>& integers, const std::vector<double>& scales) {
  const auto n = fields_of<WorldIntegers>(integers, "integers");
  const auto s = fields_of<WorldScales>(scales, "scales");
  STD_TORCH_CHECK(n.robot_count > 0 && n.cells_x > 0 && n.cells_y > 0 && n.cells_z > 0,
                  "integers: expected at least one robot and one cell per axis");
  // So that products do not overflow.
  STD_TORCH_CHECK(larger(larger(n.cells_x, n.cells_y), n.cells_z) <= 1 << 20 && n.robot_count < int64_t{1} << 31,
                  "integers: expected less than 2^31 robots and at most 2^20 cells per axis");
  STD_TORCH_CHECK(n.pattern == 0 || n.pattern == 1, "integers: unknown movement pattern ", n.pattern);
  return {n.robot_count,
          {n.cells_x, n.cells_y, n.cells_z},
          static_cast<MovementPattern>(n.pattern),
          static_cast<uint64_t>(n.seed),
          n.stay_shortest,
          n.stay_longest,
          s.radius,
          s.spacing,
          s.speed,
          s.spin,
          s.course_change,
          s.resumption,
          s.arrival,
          s.crowd};
}

inline RobotColumns robot_columns(const std::vector<Tensor>& t) {
  STD_TORCH_CHECK(t.size() == 7, "state: expected 7 tensors, got ", t.size());
  RobotColumns view;
  view.id = rows<int64_t>(t[0], "state.id", {kAnySize});
  view.count = t[0].size(0);
  view.position = rows<double>(t[1], "state.position", {view.count, 3});
  view.orientation = rows<double>(t[2], "state.orientation", {view.count, 4});
  view.velocity = rows<double>(t[3], "state.velocity", {view.count, 3});
  view.angular_velocity = rows<double>(t[4], "state.angular_velocity", {view.count, 3});
  view.target = rows<int64_t>(t[5], "state.target", {view.count});
  view.stay_until = rows<int64_t>(t[6], "state.stay_until", {view.count});
  return view;
}

inline HashColumns hash_columns(const std::vector<Tensor>& t) {
  STD_TORCH_CHECK(!t.empty() && t.size() <= HashColumns::kMost, "columns: expected 1 to ", HashColumns::kMost,
                  " tensors, got ", t.size());
  HashColumns view;
  view.columns = static_cast<int>(t.size());
  for (const Tensor& column : t) {
    check_device(column, "columns");
    STD_TORCH_CHECK(column.dim() == 1 || column.dim() == 2, "columns: expected 1 or 2 dimensions, got ", column.dim());
  }
  view.count = t[0].size(0);
  for (size_t k = 0; k < t.size(); ++k) {
    const bool has_eight_bytes = t[k].scalar_type() == ScalarType::Long || t[k].scalar_type() == ScalarType::Double;
    STD_TORCH_CHECK(has_eight_bytes, "columns: expected int64 or float64");
    STD_TORCH_CHECK(t[k].size(0) == view.count, "columns: expected ", view.count, " rows, got ", t[k].size(0));
    STD_TORCH_CHECK(t[k].is_contiguous(), "columns: expected contiguous tensors");
    view.column[k] = static_cast<const uint64_t*>(t[k].data_ptr());
    view.width[k] = t[k].dim() == 1 ? 1 : t[k].size(1);
  }
  return view;
}

// Philox counts steps and streams in 32 bits.
inline uint32_t counter_word(int64_t value, const char* name) {
  STD_TORCH_CHECK(value >= 0 && value < (int64_t{1} << 32), name, ": expected a value in [0, 2^32), got ", value);
  return static_cast<uint32_t>(value);
}

using IntegerList = std::vector<int64_t>;
using ScaleList = std::vector<double>;

inline Tensor new_rows(const Tensor& like, int64_t count, int64_t width) {
  return torch::stable::new_empty(like, {count, width}, ScalarType::Double);
}

inline Tensor new_integers(const Tensor& like, int64_t count) {
  return torch::stable::new_empty(like, {count}, ScalarType::Long);
}

template <class Session>
struct SimulateOps {
  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> simulate_start(const Tensor& id,
                                                                                   IntegerList integers,
                                                                                   ScaleList scales) {
    const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
    const int64_t count = id.size(0);
    Tensor position = new_rows(id, count, 3), orientation = new_rows(id, count, 4);
    Tensor velocity = new_rows(id, count, 3), angular_velocity = new_rows(id, count, 3);
    Tensor target = new_integers(id, count), stay_until = new_integers(id, count);
    pgccd::start_robots(Session(id).context(), world_view(integers, scales), ids, count,
                        {data<double>(position), data<double>(orientation), data<double>(velocity),
                         data<double>(angular_velocity), data<int64_t>(target), data<int64_t>(stay_until)});
    return {position, orientation, velocity, angular_velocity, target, stay_until};
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor> simulate_plan(const TensorList& state, const Tensor& step,
                                                                  IntegerList integers, ScaleList scales) {
    const RobotColumns robots = robot_columns(state);
    const int64_t* index = rows<int64_t>(step, "step", {1});
    if (!step.is_cuda()) counter_word(*index, "step");
    Tensor velocity = new_rows(state[0], robots.count, 3), angular_velocity = new_rows(state[0], robots.count, 3);
    Tensor target = new_integers(state[0], robots.count), stay_until = new_integers(state[0], robots.count);
    RobotResults results;
    results.velocity = data<double>(velocity);
    results.angular_velocity = data<double>(angular_velocity);
    results.target = data<int64_t>(target);
    results.stay_until = data<int64_t>(stay_until);
    pgccd::plan_robots(Session(state[0]).context(), world_view(integers, scales), robots, index, results);
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
    pgccd::respond_robots(Session(fraction).context(), robots, made, results);
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
    pgccd::commit_robots(Session(fraction).context(), robots, rows<double>(fraction, "fraction", {robots.count}),
                         rows<int64_t>(discard, "discard", {1}), results);
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
    pgccd::tally_step(Session(fraction).context(), outcome, reinterpret_cast<StepTally*>(data<int64_t>(tally)));
    return tally;
  }

  static Tensor simulate_hash(const TensorList& columns) {
    const HashColumns views = hash_columns(columns);
    Tensor sum = new_integers(columns[0], 1);
    pgccd::hash_rows(Session(sum).context(), views, data<uint64_t>(sum));
    return sum;
  }

  static Tensor random_uniforms(const Tensor& id, int64_t seed, int64_t step, int64_t stream) {
    const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
    const int64_t count = id.size(0);
    Tensor uniforms = new_rows(id, count, 4);
    pgccd::random_uniforms(Session(id).context(), static_cast<uint64_t>(seed), ids, count, counter_word(step, "step"),
                           counter_word(stream, "stream"), data<double>(uniforms));
    return uniforms;
  }
};

template <class Session>
void register_simulate_ops(Library& library) {
  using Ops = SimulateOps<Session>;
  library.impl("simulate_start", PGCCD_BOX(Ops::simulate_start));
  library.impl("simulate_plan", PGCCD_BOX(Ops::simulate_plan));
  library.impl("simulate_respond", PGCCD_BOX(Ops::simulate_respond));
  library.impl("simulate_commit", PGCCD_BOX(Ops::simulate_commit));
  library.impl("simulate_tally", PGCCD_BOX(Ops::simulate_tally));
  library.impl("simulate_hash", PGCCD_BOX(Ops::simulate_hash));
  library.impl("random_uniforms", PGCCD_BOX(Ops::random_uniforms));
}

}  // namespace pgccd::bind
