// The operators on the CPU.
#include "bind/arm_ops.h"
#include "bind/contact_ops.h"
#include "bind/cpu_session.h"
#include "bind/detect_ops.h"
#include "bind/distance_ops.h"
#include "bind/mesh_ops.h"
#include "bind/padded_ops.h"
#include "bind/resolve_ops.h"
#include "bind/row_ops.h"
#include "bind/simulate_ops.h"
#include "bind/subdomain_ops.h"
#include "bind/voxel_ops.h"

namespace pgccd::bind {

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  register_arm_ops<CpuSession>(library);
  register_contact_ops<CpuSession>(library);
  register_detect_ops<CpuSession>(library);
  register_distance_ops<CpuSession>(library);
  register_mesh_ops(library);
  register_padded_ops<CpuSession>(library);
  register_resolve_ops<CpuSession>(library);
  register_row_ops<CpuSession>(library);
  register_simulate_ops<CpuSession>(library);
  register_subdomain_ops<CpuSession>(library);
  register_voxel_ops(library);
}

}  // namespace pgccd::bind
