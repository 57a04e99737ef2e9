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

__global__ void __launch_bounds__(kBlockThreads) tally_step(StepOutcome outcome, StepTally* tally) {
  using Reduce = cub::BlockReduce<uint64_t, kBlockThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  const int64_t first = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  StepTally part{};
  for (int64_t row = first; row < outcome.state.count; row += stride) outcome.add_robot(row, part);
  for (int64_t row = first; row < outcome.contact_count; row += stride) outcome.add_contact(row, part);
  const uint64_t* own = reinterpret_cast<const uint64_t*>(&part);
  for (int k = 0; k < kTallyCounts; ++k) {
    __syncthreads();  // the storage is free again
    const uint64_t sum = Reduce(storage).Sum(own[k]);
    if (threadIdx.x == 0 && sum != 0) {
      atomicAdd(reinterpret_cast<unsigned long long*>(tally) + k, static_cast<unsigned long long>(sum));
    }
  }
}

unsigned blocks_for(int64_t count) {
  const int64_t blocks = (count + kBlockThreads - 1) / kBlockThreads;
  return static_cast<unsigned>(smaller<int64_t>(larger<int64_t>(blocks, 1), resident_blocks(16)));
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
    atomicMin(reinterpret_cast<long long*>(first + contacts.robot(copy)), __double_as_longlong(contacts.toi[side / 2]));
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
  hash_rows<<<blocks_for(columns.count), kBlockThreads, 0, context.stream>>>(
      columns, reinterpret_cast<unsigned long long*>(sum));
  check_cuda(cudaGetLastError(), "hash_rows");
}

void tally_step_cuda(const DeviceContext& context, const StepOutcome& outcome, StepTally* tally) {
  fill_bytes(context, tally, 0, 1);
  const int64_t count = larger(outcome.state.count, outcome.contact_count);
  tally_step<<<blocks_for(count), kBlockThreads, 0, context.stream>>>(outcome, tally);
  check_cuda(cudaGetLastError(), "tally_step");
}

}  // namespace pgccd
