#include "kernels/device.cuh"
#include "kernels/simulate/robot_item.h"
#include "kernels/simulate/simulate_cuda.h"

namespace pgccd {
void start_cuda(const DeviceContext& context, const World& world, const int64_t* id, int64_t count,
                const RobotResults& results) {
  for_each_item(context, count,
                [=] __device__(int64_t row) { store_robot(results, row, start_robot(world, id[row])); });
}

void plan_cuda(const DeviceContext& context, const World& world, const RobotColumns& robots, int64_t step,
               const RobotResults& results) {
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    Robot robot = load_robot(robots, row);
    plan_robot(world, robots.id[row], step, robot);
    store_robot(results, row, robot);
  });
}

void respond_cuda(const DeviceContext& context, const RobotColumns& robots, const double* fraction,
                  const RobotResults& results) {
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    Robot robot = load_robot(robots, row);
    respond_robot(fraction[row], robot);
    store_robot(results, row, robot);
  });
}

void random_uniforms_cuda(const DeviceContext& context, uint64_t seed, const int64_t* id, int64_t count, uint32_t step,
                          uint32_t stream, double* uniforms) {
  for_each_item(context, count, [=] __device__(int64_t row) {
    const Uniforms drawn = random_uniforms(seed, {id[row], step, stream});
    for (int k = 0; k < 4; ++k) uniforms[4 * row + k] = drawn.u[k];
  });
}

}  // namespace pgccd
