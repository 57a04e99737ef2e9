// From the arguments of the simulate operators to the views that their kernels read; shared by the backends.
#pragma once

#include <cstring>

#include "bind/arguments.h"
#include "kernels/simulate/hash_item.h"
#include "kernels/simulate/pair_motion_item.h"
#include "kernels/simulate/resolution_item.h"
#include "kernels/simulate/robot.h"
#include "kernels/simulate/world.h"

namespace pgccd::bind {

template <class Fields, class Number>
Fields fields_of(const std::vector<Number>& numbers, const char* name) {
  constexpr size_t kCount = sizeof(Fields) / sizeof(Number);
  STD_TORCH_CHECK(numbers.size() == kCount, name, ": expected ", kCount, " values, got ", numbers.size());
  Fields fields;
  std::memcpy(&fields, numbers.data(), sizeof(Fields));
  return fields;
}

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

inline MovingRobots moving_robots(const std::vector<Tensor>& t, const char* name) {
  STD_TORCH_CHECK(t.size() == 5, name, ": expected 5 tensors, got ", t.size());
  MovingRobots view;
  view.id = rows<int64_t>(t[0], name, {kAnySize});
  view.count = t[0].size(0);
  view.position = rows<double>(t[1], name, {view.count, 3});
  view.orientation = rows<double>(t[2], name, {view.count, 4});
  view.velocity = rows<double>(t[3], name, {view.count, 3});
  view.angular_velocity = rows<double>(t[4], name, {view.count, 3});
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

}  // namespace pgccd::bind
