// The detection operators in given capacities, which do not synchronise: rows beyond a capacity are counted. Templates
// over the session that they run in.
#pragma once

#include <tuple>

#include "bind/detect_ops.h"
#include "kernels/pipeline/pipeline.h"

namespace pgccd::bind {

// Options of a search besides lengths; flags are nonzero if set. In Python: pgccd/search/query.py.
struct QueryOptions {
  int64_t nonzero_toi, tests_start, report;
};

template <class Session>
struct PaddedOps {
  // Columns of contacts, body pairs (rows, 2) first; and all counts.
  using Found = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static std::tuple<Tensor, Tensor> pairs(const OptionalTensorList& swept, const std::optional<Tensor>& is_invalid,
                                          double min_separation, double tolerance, int64_t broad_phase,
                                          const std::vector<int64_t>& capacity, bool at_any_times) {
    BroadBodies bodies = broad_view(swept, {min_separation, tolerance});
    bodies.is_invalid = optional_column<int64_t>(is_invalid, "is_invalid", 1);
    bodies.at_any_times = at_any_times;
    check_capacity(capacity, 3);
    const Tensor& like = *swept[0];
    Tensor rows = new_tensor<int64_t>(like, {capacity[0], 2}), counts = new_tensor<int64_t>(like, {kPairCounts});
    const PaddedPairs out{{capacity[0], capacity[1], capacity[2] != 0}, data<int64_t>(rows), data<int64_t>(counts)};
    pgccd::find_pairs(Session(like).context(), bodies, broad_phase_choice(broad_phase, -1), out);
    return {rows, counts};
  }

  // A whole step: the pairs, then their contacts. If a row is invalid, no pairs are found; but with `searches_sound`
  // those of all bodies whose spheres have a radius >= 0.
  static Found detect_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                            const OptionalTensorList& swept, const Tensor& invalid_rows, bool searches_sound,
                            double min_separation, double tolerance, const std::vector<int64_t>& options,
                            int64_t broad_phase, const std::vector<int64_t>& pair_capacity,
                            const std::vector<int64_t>& capacity) {
    const RigidBodies view = rigid_view(mesh_set, bodies, linear_path);
    const int64_t count = view.centres.count;
    BroadBodies spheres = broad_view(swept, {min_separation, tolerance});
    STD_TORCH_CHECK(spheres.count == count, "swept: expected ", count, " spheres, one a body, got ", spheres.count);
    const int64_t* const first = rows<int64_t>(invalid_rows, "invalid_rows", {kAnySize});
    STD_TORCH_CHECK(invalid_rows.size(0) > 0, "invalid_rows: expected a number at least");
    if (!searches_sound) spheres.is_invalid = first + invalid_rows.size(0) - 1;
    check_capacity(pair_capacity, 3);
    check_contact_capacity(capacity);
    const Tensor& like = bodies[1];
    Tensor pairs = like, counts = new_tensor<int64_t>(like, {kPairCounts});
    const auto make_rows = [&](int64_t rows) { return data<int64_t>(pairs = new_tensor<int64_t>(like, {rows, 2})); };
    const BroadPhaseChoice choice = broad_phase_choice(broad_phase, -1);
    const Session session(like);
    if (capacity.back() != kExactly) {
      const PairCapacity most{pair_capacity[0], pair_capacity[1], pair_capacity[2] != 0};
      pgccd::find_pairs(session.context(), spheres, choice,
                        PaddedPairs{most, make_rows(most.pairs), data<int64_t>(counts)});
    } else if constexpr (Session::kHostKnowsCounts) {
      find_pairs_exactly(session.context(), spheres, choice, pair_capacity[0], make_rows, data<int64_t>(counts));
    }
    return contacts(view, pairs, counts, invalid_rows, {min_separation, tolerance}, options, capacity);
  }

  static Found contacts_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                              const Tensor& pairs, const Tensor& pair_counts, const Tensor& invalid_rows,
                              double min_separation, double tolerance, const std::vector<int64_t>& options,
                              const std::vector<int64_t>& capacity) {
    return contacts(rigid_view(mesh_set, bodies, linear_path), pairs, pair_counts, invalid_rows,
                    {min_separation, tolerance}, options, capacity);
  }

  static Found contacts_deforming(const TensorList& mesh_set, const TensorList& bodies, const Tensor& pairs,
                                  const Tensor& pair_counts, const Tensor& invalid_rows, double min_separation,
                                  double tolerance, const std::vector<int64_t>& options,
                                  const std::vector<int64_t>& capacity) {
    return contacts(deforming_view(mesh_set, bodies), pairs, pair_counts, invalid_rows, {min_separation, tolerance},
                    options, capacity);
  }

  // Lowers the first toi of the owners of each pair; computes no other column, and does not test starts.
  static Tensor lower_first_toi_rigid(Tensor first, const Tensor& owners, const TensorList& mesh_set,
                                      const TensorList& bodies, bool linear_path, const Tensor& pairs,
                                      const Tensor& pair_counts, double min_separation, double tolerance,
                                      bool nonzero_toi, const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 7);
    ContactSearch search =
        search_of(pairs, pair_counts, {min_separation, tolerance, nonzero_toi}, false, Report::kFirst);
    search.traverse_capacity = traverse_capacity(capacity);
    search.contact_capacity = {capacity[6], 0};
    rows<double>(first, "first", {kAnySize});
    const FirstToi known{rows<int64_t>(owners, "owners", {pairs.size(0), 2}), data<double>(first), first.size(0)};
    const Session session(pairs);
    Tensor counts = begin_counts(session, search, pairs, pair_counts, nullptr, 0);
    pgccd::lower_first_toi(session.context(), rigid_view(mesh_set, bodies, linear_path), search, known);
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
    search.narrow.may_have_starts = tests_start;
    search.narrow.report = report;
    return search;
  }

  // All counts of a step, those of its pairs first, followed by `more_count` values copied from `more`.
  static Tensor begin_counts(const Session& session, ContactSearch& search, const Tensor& pairs,
                             const Tensor& pair_counts, const int64_t* more, int64_t more_count) {
    constexpr int64_t kCounts = kPairCounts + int64_t{kTraverseCounts} + int64_t{kContactCounts};
    Tensor counts = new_tensor<int64_t>(pairs, {kCounts + more_count});
    int64_t* const begin = data<int64_t>(counts);
    search.traverse_counts = begin + kPairCounts;
    search.contact_counts = search.traverse_counts + kTraverseCounts;
    const int64_t* of_pairs = rows<int64_t>(pair_counts, "pair_counts", {kPairCounts});
    pgccd::begin_counts(session.context(), {of_pairs, kPairCounts, begin}, {more, more_count, begin + kCounts},
                        search.traverse_counts + kTraverseBegan);
    return counts;
  }

  static TraverseCapacity traverse_capacity(const std::vector<int64_t>& capacity) {
    return {capacity[0], capacity[1], capacity[2], capacity[3], capacity[4], capacity[5] != 0};
  }

  static void check_contact_capacity(const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 8);
    STD_TORCH_CHECK(Session::kHostKnowsCounts || capacity.back() != kExactly,
                    "capacity: an exact number of contacts needs the CPU; on a GPU give a capacity");
  }

  // Rows have 32-bit numbers.
  static void check_capacity(const std::vector<int64_t>& capacity, size_t count) {
    STD_TORCH_CHECK(capacity.size() == count, "capacity: expected ", count, " numbers, got ", capacity.size());
    constexpr size_t kWithContacts = 8;
    for (size_t k = 0; k < count; ++k) {
      const int64_t least = count == kWithContacts && k + 1 == count ? kExactly : 0;
      STD_TORCH_CHECK(capacity[k] >= least && capacity[k] < (int64_t{1} << 31),
                      "capacity: expected numbers in [0, 2^31), got ", capacity[k]);
    }
  }

  template <class Bodies>
  static Found contacts(const Bodies& bodies, const Tensor& pairs, const Tensor& pair_counts,
                        const Tensor& invalid_rows, const KeptDistance& kept, const std::vector<int64_t>& options,
                        const std::vector<int64_t>& capacity) {
    check_contact_capacity(capacity);
    const auto chosen = fields_of<QueryOptions>(options, "options");
    ContactSearch search = search_of(pairs, pair_counts, {kept.separation, kept.tolerance, chosen.nonzero_toi != 0},
                                     chosen.tests_start != 0, report_of(chosen.report));
    search.traverse_capacity = traverse_capacity(capacity);
    search.contact_capacity = {capacity[6], capacity[7]};
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
    const int64_t* handed_on = rows<int64_t>(invalid_rows, "invalid_rows", {kAnySize});
    const Session session(pairs);
    Tensor counts = begin_counts(session, search, pairs, pair_counts, handed_on, invalid_rows.size(0));
    pgccd::find_contacts(session.context(), bodies, search, make_output);
    return std::tuple_cat(found, std::make_tuple(counts));
  }
};

template <class Session>
void register_padded_ops(Library& library) {
  using Ops = PaddedOps<Session>;
  library.impl("pairs_padded", PGCCD_BOX(Ops::pairs));
  library.impl("detect_rigid", PGCCD_BOX(Ops::detect_rigid));
  library.impl("contacts_padded_rigid", PGCCD_BOX(Ops::contacts_rigid));
  library.impl("contacts_padded_deforming", PGCCD_BOX(Ops::contacts_deforming));
  library.impl("lower_first_toi_rigid", PGCCD_BOX(Ops::lower_first_toi_rigid));
}

}  // namespace pgccd::bind
