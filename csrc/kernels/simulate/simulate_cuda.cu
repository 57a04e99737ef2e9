#include <cub/cub.cuh>

#include "kernels/launch.cuh"
#include "kernels/simulate/robot_item.h"
#include "kernels/simulate/simulate.h"

namespace pgccd {
namespace {

__global__ void __launch_bounds__(kBlockThreads) hash_rows_kernel(HashColumns columns, unsigned long long* sum) {
  wait_for_previous_kernels();
  using Reduce = cub::BlockReduce<unsigned long long, kBlockThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  unsigned long long part = 0;
  for (int64_t row = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; row < columns.count; row += stride) {
    part += row_hash(columns, row);
  }
  part = Reduce(storage).Sum(part);
  if (threadIdx.x == 0) atomicAdd(sum, part);
}

__global__ void __launch_bounds__(kBlockThreads) tally_step_kernel(StepOutcome outcome, StepTally* tally) {
  wait_for_previous_kernels();
  using Reduce = cub::BlockReduce<uint64_t, kBlockThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  const int64_t first = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  StepTally part{};
  for (int64_t row = first; row < outcome.state.count; row += stride) outcome.add_robot(row, part);
  for (int64_t row = first; row < outcome.contact_count; row += stride) {
    require_on_device(outcome.is_sound(row), "pairs: expected padding, or robots");
    outcome.add_contact(row, part);
  }
  const uint64_t* own = reinterpret_cast<const uint64_t*>(&part);
  for (int k = 0; k < kTallyCounts; ++k) {
    __syncthreads();  // before the storage is reused
    const uint64_t sum = Reduce(storage).Sum(own[k]);
    if (threadIdx.x == 0 && sum != 0) {
      atomicAdd(reinterpret_cast<unsigned long long*>(tally) + k, static_cast<unsigned long long>(sum));
    }
  }
}

}  // namespace

void start_robots(const DeviceContext& context, const World& world, const int64_t* id, int64_t count,
                  const RobotResults& results) {
  for_each_item(context, count,
                [=] __device__(int64_t row) { store_robot(results, row, start_robot(world, id[row])); });
}

void plan_robots(const DeviceContext& context, const World& world, const RobotColumns& robots, const int64_t* step,
                 const RobotResults& results) {
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    Robot robot = load_robot(robots, row);
    plan_robot(world, robots.id[row], *step, robot);
    store_robot(results, row, robot);
  });
}

void respond_robots(const DeviceContext& context, const RobotColumns& robots, const double* fraction,
                    const RobotResults& results) {
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    Robot robot = load_robot(robots, row);
    respond_robot(fraction[row], robot);
    store_robot(results, row, robot);
  });
}

void commit_robots(const DeviceContext& context, const RobotColumns& robots, const double* fraction,
                   const int64_t* discard, const RobotResults& results) {
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    if (*discard != 0) return;
    Robot robot = load_robot(robots, row);
    respond_robot(fraction[row], robot);
    store_robot(results, row, robot);
  });
}

void random_uniforms(const DeviceContext& context, uint64_t seed, const int64_t* id, int64_t count, uint32_t step,
                     uint32_t stream, double* uniforms) {
  for_each_item(context, count, [=] __device__(int64_t row) {
    const Uniforms drawn = random_uniforms(seed, {id[row], step, stream});
    for (int k = 0; k < 4; ++k) uniforms[4 * row + k] = drawn.u[k];
  });
}

void hash_rows(const DeviceContext& context, const HashColumns& columns, uint64_t* sum) {
  fill_bytes(context, sum, 0, 1);
  if (columns.count == 0) return;
  launch_kernel(context, hash_rows_kernel, looping_blocks_for(context, columns.count), kBlockThreads, columns,
                reinterpret_cast<unsigned long long*>(sum));
}

void tally_step(const DeviceContext& context, const StepOutcome& outcome, StepTally* tally) {
  fill_bytes(context, tally, 0, 1);
  const int64_t count = larger(outcome.state.count, outcome.contact_count);
  launch_kernel(context, tally_step_kernel, looping_blocks_for(context, count), kBlockThreads, outcome, tally);
}

}  // namespace pgccd
