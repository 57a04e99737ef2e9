// Boxes of swept spheres, used to distribute bodies over ranks.
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def(
      "swept_boxes(Tensor position_t0, Tensor position_t1, Tensor radius, float min_separation, float tolerance) -> "
      "(Tensor lower, Tensor upper)");
}
