// The operators of the nanorobot simulation on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/cuda_backend.h"
#include "bind/simulate_ops.h"
#include "kernels/simulate/simulate_cuda.h"

namespace pgccd::bind {
namespace {

class SimulateOnCuda {
 public:
  explicit SimulateOnCuda(const Tensor& like) : session_(like) {}

  void start(const World& world, const int64_t* id, int64_t count, const RobotResults& results) const {
    start_cuda(session_.context(), world, id, count, results);
  }
  void plan(const World& world, const RobotColumns& robots, const int64_t* step, const RobotResults& results) const {
    plan_cuda(session_.context(), world, robots, step, results);
  }
  void respond(const RobotColumns& robots, const double* fraction, const RobotResults& results) const {
    respond_cuda(session_.context(), robots, fraction, results);
  }
  void commit(const RobotColumns& robots, const double* fraction, const int64_t* discard,
              const RobotResults& results) const {
    commit_cuda(session_.context(), robots, fraction, discard, results);
  }
  void random_uniforms(uint64_t seed, const int64_t* id, int64_t count, uint32_t step, uint32_t stream,
                       double* uniforms) const {
    random_uniforms_cuda(session_.context(), seed, id, count, step, stream, uniforms);
  }
  void slow_all_down(const SlowAllDown& robots, int64_t* changes) const {
    slow_all_down_cuda(session_.context(), robots, changes);
  }
  void first_toi(const FirstToiInput& contacts, double* first) const {
    first_toi_cuda(session_.context(), contacts, first);
  }
  void affected_motion(const AffectedMotion& given) const { affected_motion_cuda(session_.context(), given); }
  void tally_step(const StepOutcome& outcome, StepTally* tally) const {
    tally_step_cuda(session_.context(), outcome, tally);
  }
  void hash_rows(const HashColumns& columns, uint64_t* sum) const { hash_rows_cuda(session_.context(), columns, sum); }

 private:
  CudaSession session_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) { PGCCD_REGISTER_SIMULATE_OPS(library, SimulateOnCuda); }

}  // namespace pgccd::bind

#endif
