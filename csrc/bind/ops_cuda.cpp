// The operators on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/arm_ops.h"
#include "bind/contact_ops.h"
#include "bind/cuda_session.h"
#include "bind/detect_ops.h"
#include "bind/distance_ops.h"
#include "bind/graph_ops.h"
#include "bind/padded_ops.h"
#include "bind/peer_ops.h"
#include "bind/resolve_ops.h"
#include "bind/row_ops.h"
#include "bind/simulate_ops.h"
#include "bind/subdomain_ops.h"

namespace pgccd::bind {

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) {
  register_arm_ops<CudaSession>(library);
  register_contact_ops<CudaSession>(library);
  register_detect_ops<CudaSession>(library);
  register_distance_ops<CudaSession>(library);
  register_padded_ops<CudaSession>(library);
  register_resolve_ops<CudaSession>(library);
  register_row_ops<CudaSession>(library);
  register_simulate_ops<CudaSession>(library);
  register_subdomain_ops<CudaSession>(library);
  register_peer_ops(library);
  register_graph_ops(library);
}

}  // namespace pgccd::bind

#endif
