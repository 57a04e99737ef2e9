// The detection operators on the CPU.
#include <algorithm>
#include <cstring>

#include "bind/cpu_executor.h"
#include "bind/detect_ops.h"
#include "bind/elementary_ops.h"
#include "kernels/bounds/bounds.h"
#include "kernels/broad/broad.h"

namespace pgccd::bind {
namespace {

class CpuBackend {
 public:
  explicit CpuBackend(const Tensor&) {}

  void rotations_between(const double* q0, const double* q1, int64_t count, double* rotation) const {
    rotations_between_cpu(executor_, q0, q1, count, rotation);
  }
  void first_unfit_row(const FitnessColumn& column, int64_t count, int64_t* first) const {
    first_unfit_row_cpu(executor_, column, count, first);
  }
  void refit(const DeformingInput& input, const DeformingBounds& bounds) const { refit_cpu(executor_, input, bounds); }

  void sweep(const BroadBodies& bodies, int axis, const PairOutput& make_output) const {
    sweep_cpu(executor_, bodies, axis, make_output);
  }
  void grid(const BroadBodies& bodies, const PairOutput& make_output) const {
    grid_cpu(executor_, bodies, make_output);
  }
  void lbvh(const BroadBodies& bodies, const PairOutput& make_output) const {
    lbvh_cpu(executor_, bodies, make_output);
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
    const ContactRows found = narrow_phase_cpu(executor_, bodies, input);
    const ContactColumns out = make_output(static_cast<int64_t>(found.pair.size()));
    copy(found.pair, out.pair);
    copy(found.kind, out.kind);
    copy(found.features, out.features);
    copy(found.status, out.status);
    copy(found.toi, out.toi);
    copy(found.coordinates, out.coordinates);
    copy(found.point, out.point);
    copy(found.normal, out.normal);
  }

  template <bool kEdgeEdge, class T>
  void elementary(const T* x0, const T* x1, int64_t count, const NarrowSettings& settings,
                  const ElementaryColumns<T>& out) const {
    elementary_cpu<kEdgeEdge>(executor_, x0, x1, count, settings, out);
  }

 private:
  template <class T, class Target>
  static void copy(const std::vector<T>& values, Target* target) {
    if (!values.empty()) std::memcpy(target, values.data(), values.size() * sizeof(T));
  }

  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  PGCCD_REGISTER_DETECT_OPS(library, CpuBackend);
  PGCCD_REGISTER_ELEMENTARY_OPS(library, CpuBackend);
}

}  // namespace pgccd::bind
