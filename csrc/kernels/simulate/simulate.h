// Kernels of the nanorobot simulation, for results that must be bitwise equal on all devices.
#pragma once

#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/simulate/hash_item.h"
#include "kernels/simulate/robot.h"
#include "kernels/simulate/world.h"

namespace pgccd {

// Initial states of the robots `id` (count,). Fills all columns.
void start_robots(const Executor& executor, const World& world, const int64_t* id, int64_t count,
                  const RobotResults& results);
void start_robots(const DeviceContext& context, const World& world, const int64_t* id, int64_t count,
                  const RobotResults& results);

// Velocities, targets and stays for step number `step` (1,).
void plan_robots(const Executor& executor, const World& world, const RobotColumns& robots, const int64_t* step,
                 const RobotResults& results);
void plan_robots(const DeviceContext& context, const World& world, const RobotColumns& robots, const int64_t* step,
                 const RobotResults& results);

// Poses at the end of the step and velocities after it. fraction (count,): part of the step that each robot moves.
void respond_robots(const Executor& executor, const RobotColumns& robots, const double* fraction,
                    const RobotResults& results);
void respond_robots(const DeviceContext& context, const RobotColumns& robots, const double* fraction,
                    const RobotResults& results);

// As respond_robots, unless `discard` (1,) is nonzero: then nothing is written. Results may alias the columns.
void commit_robots(const Executor& executor, const RobotColumns& robots, const double* fraction, const int64_t* discard,
                   const RobotResults& results);
void commit_robots(const DeviceContext& context, const RobotColumns& robots, const double* fraction,
                   const int64_t* discard, const RobotResults& results);

// (count, 4) uniforms in (0, 1) of the counters (id, step, stream).
void random_uniforms(const Executor& executor, uint64_t seed, const int64_t* id, int64_t count, uint32_t step,
                     uint32_t stream, double* uniforms);
void random_uniforms(const DeviceContext& context, uint64_t seed, const int64_t* id, int64_t count, uint32_t step,
                     uint32_t stream, double* uniforms);

// What a step did, and the hashes of the robots and contacts after it.
void tally_step(const Executor& executor, const StepOutcome& outcome, StepTally* tally);
void tally_step(const DeviceContext& context, const StepOutcome& outcome, StepTally* tally);

// The sum of the rows' hashes modulo 2^64.
void hash_rows(const Executor& executor, const HashColumns& columns, uint64_t* sum);
void hash_rows(const DeviceContext& context, const HashColumns& columns, uint64_t* sum);

}  // namespace pgccd
