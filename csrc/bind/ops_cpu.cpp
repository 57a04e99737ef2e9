// The detection operators on the CPU.
#include <algorithm>
#include <chrono>

#include "bind/bounds_ops.h"
#include "bind/cpu_executor.h"
#include "bind/detect_ops.h"
#include "bind/elementary_ops.h"
#include "bind/padded_ops.h"
#include "kernels/bounds/bounds.h"
#include "kernels/broad/broad.h"
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
    copy_rows(found, make_output(rows), rows);
  }

  void begin_counts(const CountSpan& first, const CountSpan& second, int64_t* time) const {
    *time = nanoseconds();
    for (const CountSpan& span : {first, second}) std::copy_n(span.from, span.count, span.to);
  }
  void first_faults(const std::vector<RowColumn>& columns, int64_t* first) const {
    first_faults_cpu(executor_, columns, first);
  }
  void pairs_padded(const BroadBodies& bodies, const BroadPhaseChoice& choice, const PaddedPairs& out) const {
    out.counts[kBroadBegan] = nanoseconds();
    const int64_t capacity = out.capacity.pairs;
    std::vector<int64_t> too_many;
    int64_t count = 0;
    const auto make_output = [&](int64_t found) {
      count = found;
      if (found <= capacity) return out.rows;
      too_many.resize(2 * found);
      return too_many.data();
    };
    if (!bodies.invalid()) find_pairs(bodies, choice, make_output);
    const int64_t written = std::min(count, capacity);
    if (!too_many.empty()) std::copy_n(too_many.data(), 2 * written, out.rows);
    std::fill(out.rows + 2 * written, out.rows + 2 * capacity, int64_t{-1});
    out.counts[kPairsNeeded] = count;
    out.counts[kOverlapsNeeded] = out.counts[kLongRowsNeeded] = 0;
    out.counts[kPairsWritten] = written;
    out.counts[kPairsOverflow] = count > capacity;
    out.counts[kBroadEnded] = nanoseconds();
  }

  void require_owners(const int64_t* owners, const int64_t* given, int64_t most, int64_t limit) const {
    require_rows(executor_, std::clamp<int64_t>(*given, 0, most), "owners", "name rows of first",
                 [&](int64_t k) { return is_within(owners[2 * k], limit) && is_within(owners[2 * k + 1], limit); });
  }

  // Takes the memory it needs: only rows can be too many.
  template <class Bodies>
  void contacts_padded(const Bodies& bodies, TraverseInput traversal, const int64_t* pair_count,
                       const TraverseCapacity&, NarrowInput narrow, bool only_earliest, const ContactCapacity& capacity,
                       const ContactOutput& make_output, int64_t* traverse_counts, int64_t* contact_counts) const {
    int64_t narrow_time = 0;
    const ContactRows found = search_padded(bodies, traversal, pair_count, narrow, only_earliest, traverse_counts,
                                            contact_counts, narrow_time);
    const int64_t rows = static_cast<int64_t>(found.pair.size());
    const int64_t most = capacity.contacts == kExactly ? rows : capacity.contacts, written = std::min(rows, most);
    const ContactColumns out = make_output(most);
    copy_rows(found, out, written);
    for (int64_t row = 0; row < written; ++row) {
      std::copy_n(narrow.pairs + 2 * int64_t{found.pair[row]}, 2, out.bodies + 2 * row);
    }
    pad_rows(out, written, most);
    contact_counts[kContactsNeeded] = rows;
    contact_counts[kContactsOverflow] = rows > most;
    contact_counts[kUnresolvedWritten] =
        std::count(found.status.begin(), found.status.begin() + written, static_cast<int8_t>(Status::kUnresolved));
    end_counts(narrow_time, traverse_counts, contact_counts);
  }

  void lower_first_toi(const RigidBodies& bodies, const TraverseInput& traversal, const int64_t* pair_count,
                       const TraverseCapacity&, const NarrowInput& narrow, int64_t, const FirstToi& known,
                       int64_t* traverse_counts, int64_t* contact_counts) const {
    int64_t narrow_time = 0;
    const ContactRows found =
        search_padded(bodies, traversal, pair_count, narrow, false, traverse_counts, contact_counts, narrow_time);
    for (size_t row = 0; row < found.pair.size(); ++row) {
      for (int side = 0; side < 2; ++side) {
        double& first = known.first[known.owners[2 * int64_t{found.pair[row]} + side]];
        first = smaller(first, found.toi[row]);
      }
    }
    contact_counts[kContactsNeeded] = static_cast<int64_t>(found.pair.size());
    end_counts(narrow_time, traverse_counts, contact_counts);
  }

  template <bool kEdgeEdge, class T>
  void elementary(const T* x0, const T* x1, int64_t count, const NarrowSettings& settings,
                  const ElementaryColumns<T>& out) const {
    elementary_cpu<kEdgeEdge>(executor_, x0, x1, count, settings, out);
  }

 private:
  // Contacts of the first `pair_count` pairs. Clears the counts, and fills in those of the traversal.
  template <class Bodies>
  ContactRows search_padded(const Bodies& bodies, TraverseInput traversal, const int64_t* pair_count,
                            NarrowInput narrow, bool only_earliest, int64_t* traverse_counts, int64_t* contact_counts,
                            int64_t& narrow_time) const {
    const int64_t began = traverse_counts[kTraverseBegan];
    std::fill_n(traverse_counts, int64_t{kTraverseCounts}, int64_t{0});
    std::fill_n(contact_counts, int64_t{kContactCounts}, int64_t{0});
    traverse_counts[kTraverseBegan] = began;
    traversal.pair_count = narrow.pair_count = std::clamp<int64_t>(*pair_count, 0, traversal.pair_count);
    std::vector<double> horizon;
    if (narrow.report == Report::kFirst) {
      // A good guess at each pair's first contact bounds the times at which an earlier one must be searched for. A GPU
      // has searched all of it sooner than it has found the guess.
      traversal.leading = true;
      const ContactRows guess = search(bodies, traversal, narrow, traverse_counts, narrow_time);
      traversal.leading = false;
      horizon.assign(traversal.pair_count, 1.0);
      for (size_t row = 0; row < guess.pair.size(); ++row) horizon[guess.pair[row]] = guess.toi[row];
      if (only_earliest && !horizon.empty()) {
        std::fill(horizon.begin(), horizon.end(), *std::min_element(horizon.begin(), horizon.end()));
      }
      traversal.horizon = horizon.data();
    }
    return search(bodies, traversal, narrow, traverse_counts, narrow_time);
  }

  static void end_counts(int64_t narrow_time, int64_t* traverse_counts, int64_t* contact_counts) {
    contact_counts[kNarrowEnded] = nanoseconds();
    traverse_counts[kTraverseEnded] = contact_counts[kNarrowEnded] - narrow_time;
  }

  static int64_t nanoseconds() {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
  }
  template <class Bodies>
  ContactRows search(const Bodies& bodies, const TraverseInput& traversal, NarrowInput narrow, int64_t* traverse_counts,
                     int64_t& narrow_time) const {
    const CandidateList list = traverse_cpu(executor_, bodies, traversal);
    std::vector<Candidate> candidates;
    candidates.reserve(list.size());
    for (const auto& part : list.parts) candidates.insert(candidates.end(), part.begin(), part.end());
    traverse_counts[kCandidatesNeeded] += list.size();
    traverse_counts[kNodeTests] += list.node_tests;
    const int64_t start = nanoseconds();
    narrow.candidates = {candidates.data(), list.size()};
    ContactRows found = narrow_phase_cpu(executor_, bodies, narrow);
    narrow_time += nanoseconds() - start;
    return found;
  }
  template <class T>
  static void copy(const std::vector<T>& values, int64_t count, T* target) {
    std::copy_n(values.data(), count, target);
  }
  static void copy_rows(const ContactRows& found, const ContactColumns& out, int64_t rows) {
    if (out.pair != nullptr) copy(found.pair, rows, out.pair);
    copy(found.kind, rows, out.kind);
    copy(found.features, 2 * rows, out.features);
    copy(found.status, rows, out.status);
    copy(found.toi, rows, out.toi);
    copy(found.coordinates, 2 * rows, out.coordinates);
    copy(found.point, 3 * rows, out.point);
    copy(found.normal, 3 * rows, out.normal);
  }
  static void pad_rows(const ContactColumns& out, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) pad_row(out, row);
  }

  TorchExecutor executor_;
};

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  PGCCD_REGISTER_BOUNDS_OPS(library, CpuBackend);
  PGCCD_REGISTER_DETECT_OPS(library, CpuBackend);
  PGCCD_REGISTER_WITHIN_OPS(library, CpuBackend);
  PGCCD_REGISTER_ELEMENTARY_OPS(library, CpuBackend);
}

}  // namespace pgccd::bind
