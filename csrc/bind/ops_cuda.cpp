// The detection operators on a CUDA device.
#if defined(PGCCD_WITH_CUDA)

#include "bind/bounds_ops.h"
#include "bind/cuda_session.h"
#include "bind/detect_ops.h"
#include "bind/elementary_ops.h"
#include "bind/padded_ops.h"
#include "bind/row_ops.h"
#include "bind/simulate_ops.h"
#include "bind/subdomain_ops.h"
#include "kernels/bounds/bounds_cuda.h"
#include "kernels/bounds/faults_cuda.h"
#include "kernels/broad/broad_cuda.h"
#include "kernels/narrow/narrow_cuda.h"
#include "kernels/pipeline/pipeline_cuda.h"
#include "kernels/row_checks_cuda.h"
#include "kernels/traverse/traverse_cuda.h"

namespace pgccd::bind {
namespace {

constexpr const char* kExactNeedsCpu = "capacity: an exact number of contacts needs the CPU; on a GPU give a capacity";

class CudaBackend {
 public:
  explicit CudaBackend(const Tensor& like) : session_(like) {}

  void rotations_between(const double* q0, const double* q1, int64_t count, double* rotation) const {
    rotations_between_cuda(session_.context(), q0, q1, count, rotation);
  }
  void poses_at(const RigidPoses& poses, int64_t count, double* position, double* orientation) const {
    poses_at_cuda(session_.context(), poses, count, position, orientation);
  }
  void moving_spheres(const RigidBodies& bodies, int64_t count, const MovingSpheres& out) const {
    moving_spheres_cuda(session_.context(), bodies, count, out);
  }
  void refit(const DeformingInput& input, const DeformingBounds& bounds) const {
    refit_cuda(session_.context(), input, bounds);
  }
  void find_pairs(const BroadBodies& bodies, const BroadPhaseChoice& choice, const PairOutput& make_output) const {
    find_pairs_cuda(session_.context(), bodies, choice, make_output);
  }
  template <class Bodies>
  void traverse(const Bodies& bodies, const TraverseInput& input, const CandidateOutput& make_output,
                int64_t* node_tests) const {
    traverse_cuda(session_.context(), bodies, input, make_output, node_tests);
  }
  template <class Bodies>
  void narrow(const Bodies& bodies, const NarrowInput& input, const ContactOutput& make_output) const {
    require_candidates_cuda(session_.context(), bodies, {input.pairs, input.pair_count}, input.candidates.items,
                            input.candidates.size);
    narrow_phase_cuda(session_.context(), bodies, input, make_output);
  }
  void pairs_padded(const BroadBodies& bodies, const BroadPhaseChoice& choice, const PaddedPairs& out) const {
    find_pairs_cuda(session_.context(), bodies, choice, out);
  }
  void pairs_exactly(const BroadBodies&, const BroadPhaseChoice&, int64_t, const PairOutput&, int64_t*) const {
    STD_TORCH_CHECK(false, kExactNeedsCpu);
  }
  void begin_counts(const CountSpan& first, const CountSpan& second, int64_t* time) const {
    begin_counts_cuda(session_.context(), first, second, time);
  }
  void first_faults(const std::vector<RowColumn>& columns, const SoundRadii& radii, int64_t* first) const {
    first_faults_cuda(session_.context(), columns, radii, first);
  }
  void require_owners(const int64_t* owners, const int64_t* given, int64_t most, int64_t limit) const {
    require_owners_cuda(session_.context(), owners, given, most, limit);
  }
  template <class Bodies>
  void find_contacts(const Bodies& bodies, const ContactSearch& search, const ContactOutput& make_output) const {
    STD_TORCH_CHECK(search.contact_capacity.contacts != kExactly, kExactNeedsCpu);
    find_contacts_cuda(session_.context(), bodies, search, make_output);
  }
  void lower_first_toi(const RigidBodies& bodies, const ContactSearch& search, const FirstToi& known) const {
    lower_first_toi_cuda(session_.context(), bodies, search, known);
  }
  template <bool kEdgeEdge, class T>
  void elementary(const T* x0, const T* x1, int64_t count, const NarrowSettings& settings,
                  const ElementaryColumns<T>& out) const {
    elementary_cuda<kEdgeEdge>(session_.context(), x0, x1, count, settings, out);
  }

 private:
  CudaSession session_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CUDA, library) {
  PGCCD_REGISTER_BOUNDS_OPS(library, CudaBackend);
  PGCCD_REGISTER_DETECT_OPS(library, CudaBackend);
  PGCCD_REGISTER_PADDED_OPS(library, CudaBackend);
  PGCCD_REGISTER_ELEMENTARY_OPS(library, CudaBackend);
  register_row_ops<CudaSession>(library);
  register_simulate_ops<CudaSession>(library);
  register_subdomain_ops<CudaSession>(library);
}

}  // namespace pgccd::bind

#endif
