// CPU implementations of the nanorobot world's operators.
#include "bind/cpu_executor.h"
#include "bind/simulate_arguments.h"
#include "kernels/simulate/simulate.h"

namespace pgccd::bind {
namespace {

using TensorList = std::vector<Tensor>;
using IntegerList = std::vector<int64_t>;
using ScaleList = std::vector<double>;

Tensor new_rows(const Tensor& like, int64_t count, int64_t width) {
  return torch::stable::new_empty(like, {count, width}, ScalarType::Double);
}

Tensor new_integers(const Tensor& like, int64_t count) {
  return torch::stable::new_empty(like, {count}, ScalarType::Long);
}

template <class T>
T* data(Tensor& tensor) {
  return static_cast<T*>(tensor.data_ptr());
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> simulate_start(const Tensor& id, IntegerList integers,
                                                                          ScaleList scales) {
  const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
  const int64_t count = id.size(0);
  Tensor position = new_rows(id, count, 3), orientation = new_rows(id, count, 4);
  Tensor velocity = new_rows(id, count, 3), angular_velocity = new_rows(id, count, 3);
  Tensor target = new_integers(id, count), stay_until = new_integers(id, count);
  start_cpu(TorchExecutor(), world_view(integers, scales), ids, count,
            {data<double>(position), data<double>(orientation), data<double>(velocity), data<double>(angular_velocity),
             data<int64_t>(target), data<int64_t>(stay_until)});
  return {position, orientation, velocity, angular_velocity, target, stay_until};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> simulate_plan(const TensorList& state, int64_t step, IntegerList integers,
                                                         ScaleList scales) {
  const RobotColumns robots = robot_columns(state);
  counter_word(step, "step");
  Tensor velocity = new_rows(state[0], robots.count, 3), angular_velocity = new_rows(state[0], robots.count, 3);
  Tensor target = new_integers(state[0], robots.count), stay_until = new_integers(state[0], robots.count);
  RobotResults results;
  results.velocity = data<double>(velocity);
  results.angular_velocity = data<double>(angular_velocity);
  results.target = data<int64_t>(target);
  results.stay_until = data<int64_t>(stay_until);
  plan_cpu(TorchExecutor(), world_view(integers, scales), robots, step, results);
  return {velocity, angular_velocity, target, stay_until};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> simulate_respond(const TensorList& state, const Tensor& fraction) {
  const RobotColumns robots = robot_columns(state);
  const double* made = rows<double>(fraction, "fraction", {robots.count});
  Tensor position = new_rows(fraction, robots.count, 3), orientation = new_rows(fraction, robots.count, 4);
  Tensor velocity = new_rows(fraction, robots.count, 3), angular_velocity = new_rows(fraction, robots.count, 3);
  RobotResults results;
  results.position = data<double>(position);
  results.orientation = data<double>(orientation);
  results.velocity = data<double>(velocity);
  results.angular_velocity = data<double>(angular_velocity);
  respond_cpu(TorchExecutor(), robots, made, results);
  return {position, orientation, velocity, angular_velocity};
}

Tensor random_uniforms(const Tensor& id, int64_t seed, int64_t step, int64_t stream) {
  const int64_t* ids = rows<int64_t>(id, "id", {kAnySize});
  const int64_t count = id.size(0);
  Tensor uniforms = new_rows(id, count, 4);
  random_uniforms_cpu(TorchExecutor(), static_cast<uint64_t>(seed), ids, count, counter_word(step, "step"),
                      counter_word(stream, "stream"), data<double>(uniforms));
  return uniforms;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  library.impl("simulate_start", TORCH_BOX(&simulate_start));
  library.impl("simulate_plan", TORCH_BOX(&simulate_plan));
  library.impl("simulate_respond", TORCH_BOX(&simulate_respond));
  library.impl("random_uniforms", TORCH_BOX(&random_uniforms));
}

}  // namespace pgccd::bind
