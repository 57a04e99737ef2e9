// The operators for conditional parts of CUDA graphs.
#pragma once

#include "bind/cuda_session.h"
#include "kernels/graphs/conditional.h"

namespace pgccd::bind {

inline CUstream_st* stream_at(int64_t address) {
  STD_TORCH_CHECK(address != 0, "body: expected the address of a stream");
  return reinterpret_cast<CUstream_st*>(address);
}

inline bool has_conditional_nodes(const Tensor&) { return pgccd::has_conditional_nodes(); }

inline void begin_conditional(const Tensor& value, int64_t body) {
  const CudaSession session(value);
  pgccd::begin_conditional(session.context(), rows<int64_t>(value, "value", {1}), stream_at(body));
}

inline void end_conditional(const Tensor& value, int64_t body) {
  const CudaSession session(value);
  pgccd::end_conditional(stream_at(body));
}

inline void register_graph_ops(Library& library) {
  library.impl("has_conditional_nodes", PGCCD_BOX(has_conditional_nodes));
  library.impl("begin_conditional", PGCCD_BOX(begin_conditional));
  library.impl("end_conditional", PGCCD_BOX(end_conditional));
}

}  // namespace pgccd::bind
