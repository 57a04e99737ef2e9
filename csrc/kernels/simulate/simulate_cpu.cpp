#include "kernels/simulate/robot_item.h"
#include "kernels/simulate/simulate.h"

namespace pgccd {
namespace {

template <class Fn>
void for_each_row(const Executor& executor, int64_t count, Fn&& fn) {
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) fn(row);
  });
}

}  // namespace

void start_robots(const Executor& executor, const World& world, const int64_t* id, int64_t count,
                  const RobotResults& results) {
  for_each_row(executor, count, [&](int64_t row) { store_robot(results, row, start_robot(world, id[row])); });
}

void plan_robots(const Executor& executor, const World& world, const RobotColumns& robots, const int64_t* step,
                 const RobotResults& results) {
  for_each_row(executor, robots.count, [&](int64_t row) {
    Robot robot = load_robot(robots, row);
    plan_robot(world, robots.id[row], *step, robot);
    store_robot(results, row, robot);
  });
}

void respond_robots(const Executor& executor, const RobotColumns& robots, const double* fraction,
                    const RobotResults& results) {
  for_each_row(executor, robots.count, [&](int64_t row) {
    Robot robot = load_robot(robots, row);
    respond_robot(fraction[row], robot);
    store_robot(results, row, robot);
  });
}

void commit_robots(const Executor& executor, const RobotColumns& robots, const double* fraction, const int64_t* discard,
                   const RobotResults& results) {
  if (*discard == 0) respond_robots(executor, robots, fraction, results);
}

void random_uniforms(const Executor& executor, uint64_t seed, const int64_t* id, int64_t count, uint32_t step,
                     uint32_t stream, double* uniforms) {
  for_each_row(executor, count, [&](int64_t row) {
    const Uniforms drawn = random_uniforms(seed, {id[row], step, stream});
    for (int k = 0; k < 4; ++k) uniforms[4 * row + k] = drawn.u[k];
  });
}

void tally_step(const Executor& executor, const StepOutcome& outcome, StepTally* tally) {
  require_rows(executor, outcome.contact_count, "pairs", "are padding, or name robots",
               [&](int64_t contact) { return outcome.is_sound(contact); });
  *tally = {};
  const auto add = [&](int64_t count, const auto& add_row) {
    parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
      StepTally part{};
      for (int64_t row = begin; row < end; ++row) add_row(row, part);
      add_shared(tally->robots, part.robots, false);
      add_shared(tally->contacts_hash, part.contacts_hash, false);
      add_shared(tally->state_hash, part.state_hash, false);
      add_shared(tally->stopped, part.stopped, false);
      add_shared(tally->touching, part.touching, false);
      add_shared(tally->id_hash, part.id_hash, false);
    });
  };
  add(outcome.state.count, [&](int64_t row, StepTally& part) { outcome.add_robot(row, part); });
  add(outcome.contact_count, [&](int64_t row, StepTally& part) { outcome.add_contact(row, part); });
}

void hash_rows(const Executor& executor, const HashColumns& columns, uint64_t* sum) {
  *sum = 0;
  parallel_chunks(executor, columns.count, 1024, [&](int, int64_t begin, int64_t end) {
    uint64_t part = 0;
    for (int64_t row = begin; row < end; ++row) part += row_hash(columns, row);
    add_shared(*sum, part, false);
  });
}

}  // namespace pgccd
