// Conditional parts of CUDA graphs, see kernels/graphs/conditional_cuda.h. On GPUs only. body: a stream's address
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def("has_conditional_nodes(Tensor value) -> bool");
  library.def("begin_conditional(Tensor value, int body) -> ()");
  library.def("end_conditional(Tensor value, int body) -> ()");
}
