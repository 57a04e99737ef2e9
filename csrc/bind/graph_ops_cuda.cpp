// Conditional parts of CUDA graphs.
#if defined(PGCCD_WITH_CUDA)

#include "bind/cuda_session.h"
#include "kernels/graphs/conditional_cuda.h"

namespace pgccd::bind {
namespace {

CUstream_st* stream_at(int64_t address) {
  STD_TORCH_CHECK(address != 0, "body: expected the address of a stream");
  return reinterpret_cast<CUstream_st*>(address);
}

bool has_nodes(const Tensor&) { return has_conditional_nodes(); }

void begin_conditional(const Tensor& value, int64_t body) {
  const CudaSession session(value);
  begin_conditional_cuda(session.context(), rows<int64_t>(value, "value", {1}), stream_at(body));
}

void end_conditional(const Tensor& value, int64_t body) {
  const CudaSession session(value);
  end_conditional_cuda(stream_at(body));
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) {
  library.impl("has_conditional_nodes", TORCH_BOX(&OnOneDevice<&has_nodes>::call));
  library.impl("begin_conditional", TORCH_BOX(&OnOneDevice<&begin_conditional>::call));
  library.impl("end_conditional", TORCH_BOX(&OnOneDevice<&end_conditional>::call));
}

}  // namespace pgccd::bind

#endif
