// The detection operators in given capacities, which do not synchronise: rows beyond a capacity are counted. Written
// once for both backends.
#pragma once

#include <tuple>

#include "bind/detect_ops.h"
#include "kernels/begin_counts.h"
#include "kernels/padded_pairs.h"
#include "kernels/pipeline/contact_search.h"

namespace pgccd::bind {

template <class Backend>
struct PaddedOps {
  // Columns of contacts, body pairs (rows, 2) first; and all counts.
  using Found = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static std::tuple<Tensor, Tensor> pairs(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                                          const std::optional<Tensor>& group, const std::optional<Tensor>& mask,
                                          const std::optional<Tensor>& world, const std::optional<Tensor>& is_static,
                                          const std::optional<Tensor>& elsewhere,
                                          const std::optional<Tensor>& is_invalid, double min_separation,
                                          double tolerance, int64_t broad_phase, const std::vector<int64_t>& capacity) {
    BroadBodies bodies = broad_view(position_t0, position_t1, radius, group, mask, world, is_static, elsewhere,
                                    {min_separation, tolerance});
    bodies.is_invalid = optional_column<int64_t>(is_invalid, "is_invalid", 1);
    check_capacity(capacity, 3);
    Tensor rows = new_tensor<int64_t>(radius, {capacity[0], 2});
    Tensor counts = new_tensor<int64_t>(radius, {kPairCounts});
    const PaddedPairs out{{capacity[0], capacity[1], capacity[2] != 0}, data<int64_t>(rows), data<int64_t>(counts)};
    Backend(radius).pairs_padded(bodies, broad_phase_choice(broad_phase, -1), out);
    return {rows, counts};
  }

  // A whole step: checks of the poses and of more columns, unless their faults are given, then the pairs, then their
  // contacts. With a buffer `reach`, the pairs of bodies with valid rows are found even if others are invalid.
  static Found detect_rigid(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& bodies, bool linear_path,
                            const std::vector<Tensor>& spheres, const std::optional<Tensor>& group,
                            const std::optional<Tensor>& mask, const std::optional<Tensor>& world,
                            const std::optional<Tensor>& is_static, const std::optional<Tensor>& known_faults,
                            std::optional<Tensor> reach, const std::vector<Tensor>& more_columns,
                            const std::vector<int64_t>& checks, const std::vector<double>& limits,
                            double min_separation, double tolerance, bool nonzero_toi, bool tests_start, int64_t report,
                            int64_t broad_phase, const std::vector<int64_t>& pair_capacity,
                            const std::vector<int64_t>& capacity) {
    const RigidBodies view = rigid_view(mesh_set, bodies, linear_path);
    const int64_t count = view.centres.count;
    const bool is_own = spheres.empty();
    STD_TORCH_CHECK(is_own || spheres.size() == 3, "spheres: expected 3 tensors, or none, got ", spheres.size());
    STD_TORCH_CHECK(!is_own || (view.meshes.centres == nullptr && view.centres.margin == nullptr),
                    "spheres: expected 3 tensors where meshes are off centre or bodies have margins");
    const Tensor* const sphere = is_own ? &bodies[1] : spheres.data();
    BroadBodies swept =
        broad_view(sphere[0], sphere[1], sphere[2], group, mask, world, is_static, {}, {min_separation, tolerance});
    STD_TORCH_CHECK(swept.count == count, "spheres: expected ", count, ", one a body, got ", swept.count);
    STD_TORCH_CHECK(!known_faults || !reach, "reach: expected none where faults are given");
    SoundRadii radii;
    if (reach) {
      rows<double>(*reach, "reach", {count});
      radii = {swept.centres.radius, data<double>(*reach), count};
      swept.centres.radius = radii.copy;
    }
    TensorList columns{bodies[1], bodies[2], bodies[4], bodies[5]};
    for (const Tensor& column : more_columns) {
      rows<double>(column, "more_columns", {count, kAnySize});
      columns.push_back(column);
    }
    const Tensor faults =
        known_faults ? *known_faults : DetectOps<Backend>::find_faults(columns, checks, limits, radii);
    const int64_t* const first_faults = rows<int64_t>(faults, "faults", {kAnySize});
    STD_TORCH_CHECK(faults.size(0) > 0, "faults: expected a number at least");
    if (!reach) swept.is_invalid = first_faults + faults.size(0) - 1;
    check_capacity(pair_capacity, 3);
    check_capacity(capacity, 7);
    const Tensor& like = bodies[1];
    Tensor pairs = like, counts = new_tensor<int64_t>(like, {kPairCounts});
    const auto make_rows = [&](int64_t rows) { return data<int64_t>(pairs = new_tensor<int64_t>(like, {rows, 2})); };
    const Backend backend(like);
    const BroadPhaseChoice choice = broad_phase_choice(broad_phase, -1);
    if (capacity.back() == kExactly) {
      backend.pairs_exactly(swept, choice, pair_capacity[0], make_rows, data<int64_t>(counts));
    } else {
      const PairCapacity most{pair_capacity[0], pair_capacity[1], pair_capacity[2] != 0};
      backend.pairs_padded(swept, choice, {most, make_rows(most.pairs), data<int64_t>(counts)});
    }
    return contacts(view, pairs, counts, faults, {min_separation, tolerance, nonzero_toi}, tests_start, report,
                    capacity);
  }

  static Found contacts_rigid(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& bodies, bool linear_path,
                              const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                              double min_separation, double tolerance, bool nonzero_toi, bool tests_start,
                              int64_t report, const std::vector<int64_t>& capacity) {
    return contacts(rigid_view(mesh_set, bodies, linear_path), pairs, pair_counts, faults,
                    {min_separation, tolerance, nonzero_toi}, tests_start, report, capacity);
  }

  static Found contacts_deforming(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& bodies,
                                  const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                                  double min_separation, double tolerance, bool nonzero_toi, bool tests_start,
                                  int64_t report, const std::vector<int64_t>& capacity) {
    return contacts(deforming_view(mesh_set, bodies), pairs, pair_counts, faults,
                    {min_separation, tolerance, nonzero_toi}, tests_start, report, capacity);
  }

  // Lowers the first toi of the owners of each pair; computes no other column, and does not test starts.
  static Tensor lower_first_toi_rigid(Tensor first, const Tensor& owners, const std::vector<Tensor>& mesh_set,
                                      const std::vector<Tensor>& bodies, bool linear_path, const Tensor& pairs,
                                      const Tensor& pair_counts, double min_separation, double tolerance,
                                      bool nonzero_toi, const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 6);
    ContactSearch search =
        search_of(pairs, pair_counts, {min_separation, tolerance, nonzero_toi}, false, Report::kFirst);
    search.traverse_capacity = traverse_capacity(capacity);
    search.contact_capacity = {capacity[5], 0};
    rows<double>(first, "first", {kAnySize});
    const FirstToi known{rows<int64_t>(owners, "owners", {pairs.size(0), 2}), data<double>(first)};
    const Backend backend(pairs);
    backend.require_owners(known.owners, search.pair_count, pairs.size(0), first.size(0));
    Tensor counts = begin_counts(backend, search, pairs, pair_counts, nullptr, 0);
    backend.lower_first_toi(rigid_view(mesh_set, bodies, linear_path), search, known);
    return counts;
  }

 private:
  // The search of these pairs, without capacities and counts.
  static ContactSearch search_of(const Tensor& pairs, const Tensor& pair_counts, const NarrowSettings& settings,
                                 bool tests_start, Report report) {
    ContactSearch search;
    search.pair_count = rows<int64_t>(pair_counts, "pair_counts", {kPairCounts}) + kPairsWritten;
    search.traversal.pairs = search.narrow.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
    search.traversal.pair_count = search.narrow.pair_count = pairs.size(0);
    STD_TORCH_CHECK(search.traversal.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
    search.traversal.settings = sweep_settings(settings.separation, settings.tolerance, tests_start);
    search.narrow.settings = settings;
    search.narrow.report = report;
    return search;
  }

  // All counts of a step, those of its pairs first, followed by `more_count` values copied from `more`.
  static Tensor begin_counts(const Backend& backend, ContactSearch& search, const Tensor& pairs,
                             const Tensor& pair_counts, const int64_t* more, int64_t more_count) {
    constexpr int64_t kCounts = kPairCounts + int64_t{kTraverseCounts} + int64_t{kContactCounts};
    Tensor counts = new_tensor<int64_t>(pairs, {kCounts + more_count});
    int64_t* const begin = data<int64_t>(counts);
    search.traverse_counts = begin + kPairCounts;
    search.contact_counts = search.traverse_counts + kTraverseCounts;
    const int64_t* of_pairs = rows<int64_t>(pair_counts, "pair_counts", {kPairCounts});
    backend.begin_counts({of_pairs, kPairCounts, begin}, {more, more_count, begin + kCounts},
                         search.traverse_counts + kTraverseBegan);
    return counts;
  }

  static TraverseCapacity traverse_capacity(const std::vector<int64_t>& capacity) {
    return {capacity[0], capacity[1], capacity[2], capacity[3], capacity[4]};
  }

  // Rows have 32-bit numbers.
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
                        const NarrowSettings& settings, bool tests_start, int64_t report,
                        const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 7);
    constexpr int64_t kOnlyEarliest = 3;  // first contacts, pruned by the earliest of the scene
    ContactSearch search =
        search_of(pairs, pair_counts, settings, tests_start,
                  report_of(report == kOnlyEarliest ? static_cast<int64_t>(Report::kFirst) : report));
    search.only_earliest = report == kOnlyEarliest;
    search.traverse_capacity = traverse_capacity(capacity);
    search.contact_capacity = {capacity[5], capacity[6]};
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
    const Backend backend(pairs);
    Tensor counts = begin_counts(backend, search, pairs, pair_counts, handed_on, faults.size(0));
    backend.find_contacts(bodies, search, make_output);
    return std::tuple_cat(found, std::make_tuple(counts));
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_PADDED_OPS(library, Backend)                                                                  \
  library.impl("pairs_padded", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::pairs>::call));                           \
  library.impl("detect_rigid", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::detect_rigid>::call));                    \
  library.impl("contacts_padded_rigid", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::contacts_rigid>::call));         \
  library.impl("contacts_padded_deforming", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::contacts_deforming>::call)); \
  library.impl("lower_first_toi_rigid", TORCH_BOX(&OnOneDevice<&PaddedOps<Backend>::lower_first_toi_rigid>::call))

}  // namespace pgccd::bind
