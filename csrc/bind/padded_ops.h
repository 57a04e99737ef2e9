// The detection operators in given capacities, so that the host does not wait for the device: what does not fit is
// counted. Written once for both backends.
#pragma once

#include <tuple>

#include "bind/broad_arguments.h"
#include "bind/contact_tensors.h"
#include "kernels/begin_counts.h"
#include "kernels/padded_pairs.h"
#include "kernels/traverse/traverse.h"

namespace pgccd::bind {

template <class Backend>
struct PaddedOps {
  // Columns of contacts, with body pairs (rows, 2) first; and all counts.
  using Found = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static std::tuple<Tensor, Tensor> pairs(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                                          const std::optional<Tensor>& group, const std::optional<Tensor>& mask,
                                          const std::optional<Tensor>& world, const std::optional<Tensor>& is_static,
                                          const std::optional<Tensor>& is_invalid, double min_separation,
                                          double tolerance, int64_t broad_phase, const std::vector<int64_t>& capacity) {
    BroadBodies bodies =
        broad_view(position_t0, position_t1, radius, group, mask, world, is_static, {min_separation, tolerance});
    bodies.is_invalid = optional_column<int64_t>(is_invalid, "is_invalid", 1);
    check_capacity(capacity, 3);
    Tensor rows = new_tensor<int64_t>(radius, {capacity[0], 2});
    Tensor counts = new_tensor<int64_t>(radius, {kPairCounts});
    const PaddedPairs out{{capacity[0], capacity[1], capacity[2] != 0}, data<int64_t>(rows), data<int64_t>(counts)};
    Backend(radius).pairs_padded(bodies, broad_phase_choice(broad_phase, -1), out);
    return {rows, counts};
  }

  static Found contacts_rigid(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& bodies, bool linear_path,
                              const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                              double min_separation, double tolerance, bool nonzero_toi, int64_t report,
                              const std::vector<int64_t>& capacity) {
    return contacts(rigid_view(mesh_set, bodies, linear_path), pairs, pair_counts, faults,
                    {min_separation, tolerance, nonzero_toi}, report, capacity);
  }

  static Found contacts_deforming(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& bodies,
                                  const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                                  double min_separation, double tolerance, bool nonzero_toi, int64_t report,
                                  const std::vector<int64_t>& capacity) {
    return contacts(deforming_view(mesh_set, bodies), pairs, pair_counts, faults,
                    {min_separation, tolerance, nonzero_toi}, report, capacity);
  }

  // Of each pair only the first toi, to which that of its owners is lowered.
  static Tensor lower_first_toi_rigid(Tensor first, const Tensor& owners, const std::vector<Tensor>& mesh_set,
                                      const std::vector<Tensor>& bodies, bool linear_path, const Tensor& pairs,
                                      const Tensor& pair_counts, double min_separation, double tolerance,
                                      bool nonzero_toi, const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 6);
    const Task task(pairs, pair_counts, {min_separation, tolerance, nonzero_toi}, Report::kFirst);
    rows<double>(first, "first", {kAnySize});
    const FirstToi known{rows<int64_t>(owners, "owners", {pairs.size(0), 2}), data<double>(first)};
    CountColumn counts(pairs, 0);
    const Backend backend(pairs);
    backend.require_owners(known.owners, task.of_pairs + kPairsWritten, pairs.size(0), first.size(0));
    counts.begin(backend, task.of_pairs, {nullptr, 0, counts.end()});
    backend.lower_first_toi(rigid_view(mesh_set, bodies, linear_path), task.traversal, task.of_pairs + kPairsWritten,
                            traverse_capacity(capacity), task.narrow, capacity[5], known, counts.of_traverse(),
                            counts.of_contacts());
    return counts.column;
  }

 private:
  // Query of the pairs.
  struct Task {
    Task(const Tensor& pairs, const Tensor& pair_counts, const NarrowSettings& settings, Report report)
        : of_pairs(rows<int64_t>(pair_counts, "pair_counts", {kPairCounts})) {
      const KeptDistance kept(settings.separation, settings.tolerance);
      traversal.pairs = narrow.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
      traversal.pair_count = narrow.pair_count = pairs.size(0);
      STD_TORCH_CHECK(traversal.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
      traversal.settings = {kept.separation, kept.tolerance};
      narrow.settings = settings;
      narrow.report = report;
    }
    const int64_t* of_pairs;  // counts
    TraverseInput traversal{};
    NarrowInput narrow;
  };

  // All counts of a step, and what is handed on after them.
  struct CountColumn {
    CountColumn(const Tensor& like, int64_t more)
        : column(new_tensor<int64_t>(like, {kPairCounts + int64_t{kTraverseCounts} + int64_t{kContactCounts} + more})) {
    }
    int64_t* of_traverse() { return data<int64_t>(column) + kPairCounts; }
    int64_t* of_contacts() { return of_traverse() + kTraverseCounts; }
    int64_t* end() { return of_contacts() + kContactCounts; }
    void begin(const Backend& backend, const int64_t* of_pairs, const CountSpan& more) {
      backend.begin_counts({of_pairs, kPairCounts, data<int64_t>(column)}, more, of_traverse() + kTraverseBegan);
    }
    Tensor column;
  };

  static TraverseCapacity traverse_capacity(const std::vector<int64_t>& capacity) {
    return {capacity[0], capacity[1], capacity[2], capacity[3], capacity[4]};
  }

  // Rows are numbered by 32 bits.
  static void check_capacity(const std::vector<int64_t>& capacity, size_t count) {
    STD_TORCH_CHECK(capacity.size() == count, "capacity: expected ", count, " numbers, got ", capacity.size());
    constexpr size_t kWithContacts = 7;
    for (size_t k = 0; k < count; ++k) {
      const int64_t least = count == kWithContacts && k + 1 == count ? kExactly : 0;
      STD_TORCH_CHECK(capacity[k] >= least && capacity[k] < (int64_t{1} << 31),
                      "capacity: expected numbers in [0, 2^31), got ", capacity[k]);
    }
  }

  template <class Bodies>
  static Found contacts(const Bodies& bodies, const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                        const NarrowSettings& settings, int64_t report, const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 7);
    constexpr int64_t kOnlyEarliest = 3;  // the first contacts, of which only the earliest of all is wanted
    const Task task(pairs, pair_counts, settings,
                    report_of(report == kOnlyEarliest ? static_cast<int64_t>(Report::kFirst) : report));
    ContactTensors found{pairs, pairs, pairs, pairs, pairs, pairs, pairs, pairs};
    const auto make_output = [&](int64_t row_count) {
      found = new_contact_tensors(pairs, row_count);
      ContactColumns columns = contact_columns(found);
      Tensor body_pairs = new_tensor<int64_t>(pairs, {row_count, 2});
      columns.pair = nullptr;
      columns.bodies = data<int64_t>(body_pairs);
      std::get<0>(found) = body_pairs;
      return columns;
    };
    const int64_t* handed_on = rows<int64_t>(faults, "faults", {kAnySize});
    CountColumn counts(pairs, faults.size(0));
    const Backend backend(pairs);
    counts.begin(backend, task.of_pairs, {handed_on, faults.size(0), counts.end()});
    backend.contacts_padded(bodies, task.traversal, task.of_pairs + kPairsWritten, traverse_capacity(capacity),
                            task.narrow, report == kOnlyEarliest, {capacity[5], capacity[6]}, make_output,
                            counts.of_traverse(), counts.of_contacts());
    return std::tuple_cat(found, std::make_tuple(counts.column));
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_WITHIN_OPS(library, Backend)                                                                  \
  library.impl("pairs_padded", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::pairs>::call));                           \
  library.impl("contacts_padded_rigid", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::contacts_rigid>::call));         \
  library.impl("contacts_padded_deforming", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::contacts_deforming>::call)); \
  library.impl("lower_first_toi_rigid", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::lower_first_toi_rigid>::call))

}  // namespace pgccd::bind
