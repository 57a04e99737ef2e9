#include "kernels/find_rows.cuh"
#include "kernels/simulate/robot_item.h"
#include "kernels/simulate/simulate_cuda.h"

namespace pgccd {
namespace {

__global__ void __launch_bounds__(kBlockThreads) hash_rows(HashColumns columns, unsigned long long* sum) {
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

}  // namespace

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

void pair_motion_cuda(const DeviceContext& context, const PairMotionInput& input, const PairMotion& motion) {
  for_each_item(context, 2 * input.pair_count, [=] __device__(int64_t row) { store_pair_motion(input, row, motion); });
}

void slow_down_cuda(const DeviceContext& context, const SlowDownInput& input, double* fraction, uint8_t* changes) {
  for_each_item(context, input.count, [=] __device__(int64_t k) { slow_down(input, k, fraction, changes); });
}

void slow_all_down_cuda(const DeviceContext& context, const SlowAllDown& robots, int64_t* changes) {
  fill_bytes(context, changes, 0, 1);
  for_each_item(context, robots.count, [=] __device__(int64_t row) {
    if (robots.slow_down(row)) *changes = 1;  // whoever does writes the same
  });
}

void first_toi_cuda(const DeviceContext& context, const FirstToiInput& contacts, double* first) {
  // Doubles that are not negative are in the order of their bits.
  static_assert(sizeof(long long) == sizeof(double));
  for_each_item(context, 2 * contacts.count, [=] __device__(int64_t side) {
    const int64_t copy = contacts.pairs[side];
    if (copy < 0) return;
    atomicMin(reinterpret_cast<long long*>(first + contacts.robots[copy]),
              __double_as_longlong(contacts.toi[side / 2]));
  });
}

void concerned_pairs_cuda(const DeviceContext& context, const ConcernedPairs& concerned, int64_t pair_count,
                          const PaddedPairs& out) {
  int64_t* const rows = context.allocate<int64_t>(pair_count);
  int64_t* const found = context.allocate<int64_t>(1);
  find_rows(context, pair_count, rows, found, concerned);
  const int64_t* const pairs = concerned.pairs;
  for_each_item(context, larger<int64_t>(1, out.capacity.pairs),
                [=] __device__(int64_t k) { store_concerned_pair(pairs, rows, *found, k, out); });
}

void hash_rows_cuda(const DeviceContext& context, const HashColumns& columns, uint64_t* sum) {
  fill_bytes(context, sum, 0, 1);
  if (columns.count == 0) return;
  const int64_t blocks = (columns.count + kBlockThreads - 1) / kBlockThreads;
  hash_rows<<<static_cast<unsigned>(smaller<int64_t>(blocks, resident_blocks(16))), kBlockThreads, 0, context.stream>>>(
      columns, reinterpret_cast<unsigned long long*>(sum));
  check_cuda(cudaGetLastError(), "kernel launch");
}

}  // namespace pgccd
