// The detection operators with room instead of exact sizes, so that nothing waits for the device: what does not fit is
// counted. Written once for both backends.
#pragma once

#include <tuple>

#include "bind/contact_tensors.h"
#include "kernels/begin_counts.h"
#include "kernels/padded_pairs.h"
#include "kernels/traverse/traverse.h"

namespace pgccd::bind {

enum class BroadPhase : int64_t { kSweep = 0, kGrid = 1, kLbvh = 2 };

template <class Backend>
struct WithinOps {
  // Columns of contacts, with body pairs (rows, 2) first; and all counts.
  using Found = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static std::tuple<Tensor, Tensor> pairs(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                                          const std::optional<Tensor>& group, const std::optional<Tensor>& mask,
                                          const std::optional<Tensor>& world, const std::optional<Tensor>& is_static,
                                          const std::optional<Tensor>& is_invalid, double min_separation,
                                          int64_t broad_phase, const std::vector<int64_t>& capacity) {
    BroadBodies bodies = broad_view(position_t0, position_t1, radius, group, mask, world, is_static, min_separation);
    bodies.is_invalid = optional_column<int64_t>(is_invalid, "is_invalid", 1);
    STD_TORCH_CHECK(broad_phase >= 0 && broad_phase <= 2, "broad_phase: expected 0 (sweep), 1 (grid) or 2 (lbvh), got ",
                    broad_phase);
    check_capacity(capacity, 3);
    Tensor rows = new_tensor<int64_t>(radius, {capacity[0], 2});
    Tensor counts = new_tensor<int64_t>(radius, {kPairCounts});
    const PaddedPairs out{{capacity[0], capacity[1], capacity[2] != 0}, data<int64_t>(rows), data<int64_t>(counts)};
    Backend(radius).pairs_within(bodies, static_cast<BroadPhase>(broad_phase), out);
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

 private:
  // Rows are numbered by 32 bits.
  static void check_capacity(const std::vector<int64_t>& capacity, size_t count) {
    STD_TORCH_CHECK(capacity.size() == count, "capacity: expected ", count, " numbers, got ", capacity.size());
    for (const int64_t room : capacity) {
      STD_TORCH_CHECK(room >= kExactly && room < (int64_t{1} << 31), "capacity: expected numbers in [0, 2^31), got ",
                      room);
    }
  }

  template <class Bodies>
  static Found contacts(const Bodies& bodies, const Tensor& pairs, const Tensor& pair_counts, const Tensor& faults,
                        const NarrowSettings& settings, int64_t report, const std::vector<int64_t>& capacity) {
    check_capacity(capacity, 7);
    TraverseInput traversal{};
    traversal.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
    traversal.pair_count = pairs.size(0);
    traversal.settings = {settings.separation, settings.tolerance};
    const TraverseCapacity room{capacity[0], capacity[1], capacity[2], capacity[3], capacity[4]};
    NarrowInput narrow;
    narrow.pairs = traversal.pairs;
    narrow.pair_count = traversal.pair_count;
    narrow.settings = settings;
    constexpr int64_t kOnlyEarliest = 3;  // the first contacts, of which only the earliest of all is wanted
    narrow.report = report_of(report == kOnlyEarliest ? static_cast<int64_t>(Report::kFirst) : report);
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
    Tensor counts =
        new_tensor<int64_t>(pairs, {kPairCounts + int64_t{kTraverseCounts} + int64_t{kContactCounts} + faults.size(0)});
    const int64_t* of_pairs = rows<int64_t>(pair_counts, "pair_counts", {kPairCounts});
    const int64_t* of_faults = rows<int64_t>(faults, "faults", {kAnySize});
    int64_t* const traverse_counts = data<int64_t>(counts) + kPairCounts;
    int64_t* const contact_counts = traverse_counts + kTraverseCounts;
    const Backend backend(pairs);
    backend.begin_counts({of_pairs, kPairCounts, data<int64_t>(counts)},
                         {of_faults, faults.size(0), contact_counts + kContactCounts},
                         traverse_counts + kTraverseBegan);
    backend.contacts_within(bodies, traversal, of_pairs + kPairsWritten, room, narrow, report == kOnlyEarliest,
                            {capacity[5], capacity[6]}, make_output, traverse_counts, contact_counts);
    return std::tuple_cat(found, std::make_tuple(counts));
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_WITHIN_OPS(library, Backend)                                      \
  library.impl("pairs_within", TORCH_BOX(&WithinOps<Backend>::pairs));                   \
  library.impl("contacts_within_rigid", TORCH_BOX(&WithinOps<Backend>::contacts_rigid)); \
  library.impl("contacts_within_deforming", TORCH_BOX(&WithinOps<Backend>::contacts_deforming))

}  // namespace pgccd::bind
