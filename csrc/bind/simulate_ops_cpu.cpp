// The operators of the nanorobot simulation on the CPU.
#include "bind/cpu_executor.h"
#include "bind/simulate_ops.h"
#include "kernels/simulate/simulate.h"

namespace pgccd::bind {
namespace {

class SimulateOnCpu {
 public:
  explicit SimulateOnCpu(const Tensor&) {}

  void start(const World& world, const int64_t* id, int64_t count, const RobotResults& results) const {
    start_cpu(executor_, world, id, count, results);
  }
  void plan(const World& world, const RobotColumns& robots, const int64_t* step, const RobotResults& results) const {
    counter_word(*step, "step");
    plan_cpu(executor_, world, robots, step, results);
  }
  void respond(const RobotColumns& robots, const double* fraction, const RobotResults& results) const {
    respond_cpu(executor_, robots, fraction, results);
  }
  void commit(const RobotColumns& robots, const double* fraction, const int64_t* discard,
              const RobotResults& results) const {
    commit_cpu(executor_, robots, fraction, discard, results);
  }
  void random_uniforms(uint64_t seed, const int64_t* id, int64_t count, uint32_t step, uint32_t stream,
                       double* uniforms) const {
    random_uniforms_cpu(executor_, seed, id, count, step, stream, uniforms);
  }
  void slow_all_down(const SlowAllDown& robots, int64_t* changes) const {
    slow_all_down_cpu(executor_, robots, changes);
  }
  void first_toi(const FirstToiInput& contacts, double* first) const { first_toi_cpu(executor_, contacts, first); }
  void affected_motion(const AffectedMotion& given) const { affected_motion_cpu(executor_, given); }
  void tally_step(const StepOutcome& outcome, StepTally* tally) const { tally_step_cpu(executor_, outcome, tally); }
  void hash_rows(const HashColumns& columns, uint64_t* sum) const { hash_rows_cpu(executor_, columns, sum); }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) { PGCCD_REGISTER_SIMULATE_OPS(library, SimulateOnCpu); }

}  // namespace pgccd::bind
