// Boxes of swept spheres on the CPU.
#include "bind/box_ops.h"
#include "bind/cpu_executor.h"
#include "kernels/broad/swept_boxes.h"

namespace pgccd::bind {
namespace {

class BoxesOnCpu {
 public:
  explicit BoxesOnCpu(const Tensor&) {}

  void swept_boxes(const BroadBodies& bodies, double* lower, double* upper) const {
    swept_boxes_cpu(executor_, bodies, lower, upper);
  }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  library.impl("swept_boxes", TORCH_BOX(&OnOneDevice<&swept_boxes<BoxesOnCpu>>::call));
}

}  // namespace pgccd::bind
