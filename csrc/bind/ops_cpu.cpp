// The detection operators on the CPU.
#include <algorithm>

#include "bind/bounds_ops.h"
#include "bind/cpu_session.h"
#include "bind/detect_ops.h"
#include "bind/elementary_ops.h"
#include "bind/padded_ops.h"
#include "bind/row_ops.h"
#include "bind/simulate_ops.h"
#include "bind/subdomain_ops.h"
#include "kernels/bounds/bounds.h"
#include "kernels/pipeline/pipeline.h"
#include "kernels/row_checks.h"

namespace pgccd::bind {
namespace {

class CpuBackend {
 public:
  explicit CpuBackend(const Tensor&) {}

  void rotations_between(const double* q0, const double* q1, int64_t count, double* rotation) const {
    rotations_between_cpu(executor_, q0, q1, count, rotation);
  }
  void poses_at(const RigidPoses& poses, int64_t count, double* position, double* orientation) const {
    poses_at_cpu(executor_, poses, count, position, orientation);
  }
  void moving_spheres(const RigidBodies& bodies, int64_t count, const MovingSpheres& out) const {
    moving_spheres_cpu(executor_, bodies, count, out);
  }
  void refit(const DeformingInput& input, const DeformingBounds& bounds) const { refit_cpu(executor_, input, bounds); }

  void find_pairs(const BroadBodies& bodies, const BroadPhaseChoice& choice, const PairOutput& make_output) const {
    find_pairs_cpu(executor_, bodies, choice, make_output);
  }

  template <class Bodies, class Output>
  void traverse(const Bodies& bodies, const TraverseInput& input, Output&& make_output, int64_t* node_tests) const {
    const CandidateList list = traverse_cpu(executor_, bodies, input);
    Candidate* out = make_output(list.size());
    for (const auto& part : list.parts) out = std::copy(part.begin(), part.end(), out);
    *node_tests = list.node_tests;
  }

  template <class Bodies, class Output>
  void narrow(const Bodies& bodies, const NarrowInput& input, Output&& make_output) const {
    require_rows(
        executor_, input.candidates.size, "candidates", "name pairs, kinds and features that are there",
        [&](int64_t k) { return names_features(bodies, {input.pairs, input.pair_count}, input.candidates.items[k]); });
    const ContactRows found = narrow_phase_cpu(executor_, bodies, input);
    const int64_t rows = static_cast<int64_t>(found.pair.size());
    copy_rows(found, rows, make_output(rows));
  }

  void begin_counts(const CountSpan& first, const CountSpan& second, int64_t* time) const {
    begin_counts_cpu(first, second, time);
  }
  void first_faults(const std::vector<RowColumn>& columns, const SoundRadii& radii, int64_t* first) const {
    first_faults_cpu(executor_, columns, radii, first);
  }
  void pairs_padded(const BroadBodies& bodies, const BroadPhaseChoice& choice, const PaddedPairs& out) const {
    find_pairs_padded_cpu(executor_, bodies, choice, out);
  }

  void pairs_exactly(const BroadBodies& bodies, const BroadPhaseChoice& choice, int64_t most,
                     const PairOutput& make_output, int64_t* counts) const {
    find_pairs_exactly_cpu(executor_, bodies, choice, most, make_output, counts);
  }

  void require_owners(const int64_t* owners, const int64_t* given, int64_t most, int64_t limit) const {
    require_rows(executor_, std::clamp<int64_t>(*given, 0, most), "owners", "name rows of first",
                 [&](int64_t k) { return is_within(owners[2 * k], limit) && is_within(owners[2 * k + 1], limit); });
  }

  template <class Bodies>
  void find_contacts(const Bodies& bodies, const ContactSearch& search, const ContactOutput& make_output) const {
    find_contacts_cpu(executor_, bodies, search, make_output);
  }
  void lower_first_toi(const RigidBodies& bodies, const ContactSearch& search, const FirstToi& known) const {
    lower_first_toi_cpu(executor_, bodies, search, known);
  }

  template <bool kEdgeEdge, class T>
  void elementary(const T* x0, const T* x1, int64_t count, const NarrowSettings& settings,
                  const ElementaryColumns<T>& out) const {
    elementary_cpu<kEdgeEdge>(executor_, x0, x1, count, settings, out);
  }

 private:
  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  PGCCD_REGISTER_BOUNDS_OPS(library, CpuBackend);
  PGCCD_REGISTER_DETECT_OPS(library, CpuBackend);
  PGCCD_REGISTER_PADDED_OPS(library, CpuBackend);
  PGCCD_REGISTER_ELEMENTARY_OPS(library, CpuBackend);
  register_row_ops<CpuSession>(library);
  register_simulate_ops<CpuSession>(library);
  register_subdomain_ops<CpuSession>(library);
}

}  // namespace pgccd::bind
