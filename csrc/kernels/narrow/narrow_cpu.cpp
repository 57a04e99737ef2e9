#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <optional>
#include <tuple>

#include "kernels/narrow/contact_item.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {
namespace {

constexpr int64_t kCandidateGrain = 256;
constexpr double kNever = std::numeric_limits<double>::infinity();

struct FoundContact {
  int64_t candidate;
  Outcome<double> outcome;
};

bool is_contact(Status status) { return status == Status::kTouch || status == Status::kUnresolved; }

void lower_to(double& target, double value) {
  std::atomic_ref<double> shared(target);
  double seen = shared.load(std::memory_order_relaxed);
  while (value < seen && !shared.compare_exchange_weak(seen, value, std::memory_order_relaxed)) {
  }
}

double latest_useful(Report report, const double& best) {
  const double seen = std::atomic_ref<double>(const_cast<double&>(best)).load(std::memory_order_relaxed);
  if (report == Report::kAny) return seen < kNever ? -kNever : kNever;
  return seen;
}

// The smaller one wins among contacts with equal toi.
auto canonical_key(const Candidate& c) { return std::make_tuple(c.kind, c.feature_i, c.feature_j); }

// Solves candidates of one pair: calls keep(index, outcome) for each contact, and latest() for the time up to which
// they matter. Edges that certainly pass through faces come first, since later contacts then need no search; those for
// which rounding leaves that open come last, since they need exact arithmetic, and a contact at t = 0 of a smaller kind
// makes them superfluous if one contact is wanted (`only_one`).
template <class Bodies, class Keep, class Latest>
void solve_pair(const Bodies& bodies, const PairOf<Bodies>& pair, const NarrowInput& input, int64_t begin, int64_t end,
                bool only_one, Keep&& keep, Latest&& latest) {
  const Candidate* const candidates = input.candidates.items;
  const Candidate* best = nullptr;                         // found at t = 0
  std::optional<typename PairOf<Bodies>::Fine> fine_pair;  // once it is needed
  const auto fine = [&]() -> const auto& {
    if (!fine_pair) fine_pair.emplace(pair.fine(bodies));
    return *fine_pair;
  };
  const auto solve = [&](int64_t c) {
    const Candidate& candidate = candidates[c];
    const Outcome<double> outcome = is_of_start(candidate)
                                        ? solve_start(bodies, pair, fine, candidate)
                                        : solve_candidate(bodies, pair, candidate, input.settings, latest());
    if (!is_contact(outcome.status)) return;
    keep(c, outcome);
    if (outcome.toi > 0.0) return;
    if (best == nullptr || canonical_key(candidate) < canonical_key(*best)) best = &candidate;
  };
  const auto is_wanted = [&](const Candidate& c) {
    return !only_one || best == nullptr || (wants_first(input.report) && canonical_key(c) < canonical_key(*best));
  };
  std::vector<int64_t> open;
  for (int64_t c = begin; c < end; ++c) {
    if (!is_crossing(candidates[c]) || !is_wanted(candidates[c])) continue;
    const Crossing found = crossing_of(bodies, pair, fine, candidates[c], false);
    if (found == Crossing::kPasses) solve(c);
    if (found == Crossing::kOpen) open.push_back(c);
  }
  for (int64_t c = begin; c < end; ++c) {
    if (!is_crossing(candidates[c])) solve(c);
  }
  for (const int64_t c : open) {
    if (is_wanted(candidates[c])) solve(c);
  }
}

// Finds every contact that is not certainly later than another of its pair. Which contacts are pruned depends on
// timing; the first one does not, since it is never later than any bound.
template <class Bodies>
std::vector<FoundContact> find_contacts(const Executor& executor, const Bodies& bodies, const NarrowInput& input) {
  const bool bounded = input.report != Report::kAll;
  std::vector<double> best(bounded ? input.pair_count : 0, kNever);
  if (bounded && input.latest != nullptr) std::copy_n(input.latest, input.pair_count, best.begin());
  std::vector<std::vector<FoundContact>> found(executor.worker_count());
  parallel_chunks(executor, input.candidates.size, kCandidateGrain, [&](int worker, int64_t begin, int64_t end) {
    int64_t c = begin;
    while (c < end) {
      const int32_t row = input.candidates.items[c].pair;
      const PairOf<Bodies> pair(bodies, input.pairs[2 * int64_t{row}], input.pairs[2 * int64_t{row} + 1]);
      const int64_t first = c;
      while (c < end && input.candidates.items[c].pair == row) ++c;
      double* const pair_best = bounded ? &best[row] : nullptr;
      const auto keep = [&](int64_t candidate, const Outcome<double>& outcome) {
        found[worker].push_back({candidate, outcome});
        if (bounded) lower_to(*pair_best, outcome.toi);
      };
      const auto latest = [&] { return bounded ? latest_useful(input.report, *pair_best) : kNever; };
      solve_pair(bodies, pair, input, first, c, bounded, keep, latest);
    }
  });
  std::vector<FoundContact> all;
  for (const auto& part : found) all.insert(all.end(), part.begin(), part.end());
  return all;
}

// Sorts into canonical order, then keeps one row per pair if the report requires it.
void select(std::vector<FoundContact>& found, const NarrowInput& input) {
  const auto features = [&](const FoundContact& f) {
    const Candidate& c = input.candidates.items[f.candidate];
    return canonical_key(c);
  };
  const auto pair = [&](const FoundContact& f) { return input.candidates.items[f.candidate].pair; };
  const bool by_toi = wants_first(input.report);
  std::sort(found.begin(), found.end(), [&](const FoundContact& a, const FoundContact& b) {
    const double toi_a = by_toi ? a.outcome.toi : 0.0, toi_b = by_toi ? b.outcome.toi : 0.0;
    return std::make_tuple(pair(a), toi_a, features(a)) < std::make_tuple(pair(b), toi_b, features(b));
  });
  if (input.report == Report::kAll) return;
  found.erase(std::unique(found.begin(), found.end(),
                          [&](const FoundContact& a, const FoundContact& b) { return pair(a) == pair(b); }),
              found.end());
}

template <class Bodies>
ContactRows to_rows(const Executor& executor, const Bodies& bodies, const NarrowInput& input,
                    const std::vector<FoundContact>& found) {
  const int64_t rows = static_cast<int64_t>(found.size());
  ContactRows out;
  out.pair.resize(rows);
  out.kind.resize(rows);
  out.features.resize(2 * rows);
  out.status.resize(rows);
  out.toi.resize(rows);
  out.coordinates.resize(2 * rows);
  out.point.resize(3 * rows);
  out.normal.resize(3 * rows);
  parallel_chunks(executor, rows, kCandidateGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const Candidate& c = input.candidates.items[found[row].candidate];
      const Outcome<double>& outcome = found[row].outcome;
      const PairOf<Bodies> pair(bodies, input.pairs[2 * int64_t{c.pair}], input.pairs[2 * int64_t{c.pair} + 1]);
      const ContactPlace at = contact_place(bodies, pair, c, outcome.toi);
      out.pair[row] = c.pair;
      store_contact(out, row, c, outcome, at);
    }
  });
  return out;
}

}  // namespace

template <class Bodies>
ContactRows solve_candidates(const Executor& executor, const Bodies& bodies, const NarrowInput& input) {
  std::vector<FoundContact> found = find_contacts(executor, bodies, input);
  select(found, input);
  return to_rows(executor, bodies, input, found);
}

template <class Bodies>
PairContact contact_of_pair(const Bodies& bodies, const NarrowInput& input) {
  PairContact best;
  double latest = input.latest != nullptr ? *input.latest : kNever;
  const bool wants_first = pgccd::wants_first(input.report);
  const PairOf<Bodies> pair(bodies, input.pairs[0], input.pairs[1]);
  const auto keep = [&](int64_t candidate, const Outcome<double>& outcome) {
    const PairContact found{input.candidates.items[candidate], outcome};
    if (!best.is_found() || (wants_first && found.is_before(best))) best = found;
    latest = smaller(latest, outcome.toi);
  };
  solve_pair(bodies, pair, input, 0, input.candidates.size, true, keep,
             [&] { return latest_useful(input.report, latest); });
  return best;
}

template PairContact contact_of_pair(const RigidBodies&, const NarrowInput&);

namespace {

void append_row(ContactRows& rows, const ContactRows& from, size_t row) {
  const auto append = [row](auto& target, const auto& values, size_t width) {
    target.insert(target.end(), values.begin() + width * row, values.begin() + width * (row + 1));
  };
  append(rows.pair, from.pair, 1);
  append(rows.kind, from.kind, 1);
  append(rows.features, from.features, 2);
  append(rows.status, from.status, 1);
  append(rows.toi, from.toi, 1);
  append(rows.coordinates, from.coordinates, 2);
  append(rows.point, from.point, 3);
  append(rows.normal, from.normal, 3);
}

}  // namespace

void append_rows(ContactRows& rows, const ContactRows& more) {
  for (size_t row = 0; row < more.pair.size(); ++row) append_row(rows, more, row);
}

ContactRows by_pair_until(const ContactRows& rows, double latest) {
  std::vector<size_t> order;
  for (size_t row = 0; row < rows.pair.size(); ++row) {
    if (rows.toi[row] <= latest) order.push_back(row);
  }
  std::stable_sort(order.begin(), order.end(), [&](size_t a, size_t b) { return rows.pair[a] < rows.pair[b]; });
  ContactRows sorted;
  for (const size_t row : order) append_row(sorted, rows, row);
  return sorted;
}

ContactRows first_of_each_pair(const ContactRows& one, const ContactRows& other, const std::vector<double>& latest) {
  const auto order = [](const ContactRows& rows, size_t row) {
    return std::make_tuple(rows.pair[row], rows.toi[row], rows.kind[row], rows.features[2 * row],
                           rows.features[2 * row + 1]);
  };
  ContactRows first;
  size_t i = 0, j = 0;
  while (i < one.pair.size() || j < other.pair.size()) {
    const bool is_one = j == other.pair.size() || (i < one.pair.size() && order(one, i) < order(other, j));
    const ContactRows& from = is_one ? one : other;
    const size_t row = is_one ? i++ : j++;
    if (is_one && one.toi[row] > latest[one.pair[row]]) continue;
    if (first.pair.empty() || first.pair.back() != from.pair[row]) append_row(first, from, row);
  }
  return first;
}

void copy_contacts(const ContactRows& rows, int64_t count, const ContactColumns& out) {
  const auto copy = [&](const auto& values, int64_t width, auto* target) {
    std::copy_n(values.data(), width * count, target);
  };
  if (out.pair != nullptr) copy(rows.pair, 1, out.pair);
  copy(rows.kind, 1, out.kind);
  copy(rows.features, 2, out.features);
  copy(rows.status, 1, out.status);
  copy(rows.toi, 1, out.toi);
  copy(rows.coordinates, 2, out.coordinates);
  copy(rows.point, 3, out.point);
  copy(rows.normal, 3, out.normal);
}

template <class Bodies>
void narrow_phase(const Executor& executor, const Bodies& bodies, const NarrowInput& input,
                  const ContactOutput& make_output) {
  require_rows(
      executor, input.candidates.size, "candidates", "name pairs, kinds and features that are there",
      [&](int64_t k) { return names_features(bodies, input.pairs, input.pair_count, input.candidates.items[k]); });
  const ContactRows found = solve_candidates(executor, bodies, input);
  const auto rows = static_cast<int64_t>(found.pair.size());
  copy_contacts(found, rows, make_output(rows));
}

template void narrow_phase(const Executor&, const RigidBodies&, const NarrowInput&, const ContactOutput&);
template void narrow_phase(const Executor&, const DeformingBodies&, const NarrowInput&, const ContactOutput&);
template ContactRows solve_candidates(const Executor&, const RigidBodies&, const NarrowInput&);
template ContactRows solve_candidates(const Executor&, const DeformingBodies&, const NarrowInput&);

}  // namespace pgccd
