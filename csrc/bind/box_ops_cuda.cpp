// Boxes of swept spheres on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/box_ops.h"
#include "bind/cuda_backend.h"
#include "kernels/broad/swept_boxes_cuda.h"

namespace pgccd::bind {
namespace {

class BoxesOnCuda {
 public:
  explicit BoxesOnCuda(const Tensor& like) : session_(like) {}

  void swept_boxes(const BroadBodies& bodies, double* lower, double* upper) const {
    swept_boxes_cuda(session_.context(), bodies, lower, upper);
  }

 private:
  CudaSession session_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) {
  library.impl("swept_boxes", TORCH_BOX(&OnOneDevice<&swept_boxes<BoxesOnCuda>>::call));
}

}  // namespace pgccd::bind

#endif
