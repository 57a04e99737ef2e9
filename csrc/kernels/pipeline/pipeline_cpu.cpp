#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <span>
#include <tuple>

#include "kernels/pipeline/pipeline.h"
#include "kernels/pipeline/search_order.h"
#include "kernels/traverse/leaf_feature_item.h"
#include "kernels/traverse/leaf_separation.h"

namespace pgccd {
namespace {

// A search on the CPU: adds to the counts and to the time of the narrow phase.
template <class Bodies>
class PairSearch {
 public:
  PairSearch(const Executor& executor, const Bodies& bodies, const ContactSearch& search)
      : executor_(executor),
        bodies_(bodies),
        traversal_(search.traversal),
        narrow_(search.narrow),
        counts_(search.traverse_counts) {
    traversal_.pair_count = narrow_.pair_count =
        std::clamp<int64_t>(*search.pair_count, 0, search.traversal.pair_count);
  }

  int64_t narrow_time() const { return narrow_time_; }

  ContactRows search() {
    if (narrow_.report == Report::kAll) return search_at_once();
    const ContactRows found = search_surfaces();
    const CandidateList enclosures = list_enclosures(executor_, bodies_, traversal_);
    if (enclosures.size() == 0) return found;
    const std::vector<double> any_time(traversal_.pair_count, std::numeric_limits<double>::infinity());
    return first_of_each_pair(found, solve(enclosures), any_time);
  }

 private:
  ContactRows search_surfaces() {
    if (narrow_.report == Report::kEarliest) return search_earliest();
    if (narrow_.report == Report::kAny) return search_any();
    return search_until(std::vector<double>(traversal_.pair_count, 1.0), kAllLeaves);
  }

  ContactRows search_at_once() {
    const CandidateList list = list_candidates(executor_, bodies_, traversal_);
    counts_[kNodeTests] += list.node_tests;
    return solve(list);
  }

  // One contact of each pair until a time: the first one, unless any will do. Pairs that turn fast are at first
  // searched over a part of that time that needs no more segments than those of other pairs, then over four times that
  // part, until they have a contact.
  ContactRows search_until(const std::vector<double>& horizon, size_t most_at_start) {
    std::vector<double> until(horizon.size());
    std::vector<int32_t> open;
    for (size_t pair = 0; pair < horizon.size(); ++pair) {
      until[pair] = time_of_few_segments(static_cast<int64_t>(pair), horizon[pair]);
      if (until[pair] < horizon[pair]) open.push_back(static_cast<int32_t>(pair));
    }
    ContactRows found = search_part(until, most_at_start);
    while (!open.empty()) {
      for (const int32_t pair : found.pair) until[pair] = horizon[pair];
      std::erase_if(open, [&](int32_t pair) { return !(until[pair] < horizon[pair]); });
      std::vector<double> parts;
      for (const int32_t pair : open) {
        until[pair] = smaller(4.0 * until[pair], horizon[pair]);
        parts.push_back(until[pair]);
      }
      append_rows(found, of_pairs(open, [&] { return search_part(parts, kAllLeaves); }));
      if (open.empty()) return by_pair_until(found, std::numeric_limits<double>::infinity());
    }
    return found;
  }

  // The contacts that search() finds of some of the pairs.
  template <class Search>
  ContactRows of_pairs(std::span<const int32_t> some, Search&& search) {
    const int64_t *const traversed = traversal_.pairs, *const solved = narrow_.pairs;
    const int64_t count = traversal_.pair_count;
    std::vector<int64_t> pairs;
    pairs.reserve(2 * some.size());
    for (const int32_t pair : some) pairs.insert(pairs.end(), traversed + 2 * pair, traversed + 2 * pair + 2);
    traversal_.pairs = narrow_.pairs = pairs.data();
    traversal_.pair_count = narrow_.pair_count = static_cast<int64_t>(some.size());
    ContactRows found = search();
    for (int32_t& pair : found.pair) pair = some[pair];
    traversal_.pairs = traversed;
    narrow_.pairs = solved;
    traversal_.pair_count = narrow_.pair_count = count;
    return found;
  }

  // The part of a time for which a pair needs a sweep of few segments.
  double time_of_few_segments(int64_t pair, double horizon) const {
    if constexpr (std::is_same_v<Bodies, RigidBodies>) {
      const int64_t i = traversal_.pairs[2 * pair], j = traversal_.pairs[2 * pair + 1];
      if (!is_within(i, bodies_.centres.count) || !is_within(j, bodies_.centres.count)) return horizon;
      const auto turn = [&](int64_t body) { return norm_squared(load_vec3(bodies_.rotation + 3 * body)); };
      // Slower ones need no sweep to tell.
      if (!(sweep_detail::most_segments(horizon * std::sqrt(larger(turn(i), turn(j)))) > kStoredSegments)) {
        return horizon;
      }
      if (!is_sound(bodies_, i) || !is_sound(bodies_, j)) return horizon;
      const RigidSweep sweep(bodies_, i, j, traversal_.settings, horizon);
      return sweep.turns_fast() ? horizon * (kStoredSegments - 1) / sweep.segment_count : horizon;
    }
    return horizon;
  }

  // Leaves are searched in batches, first those that may meet first, over the motion until the contacts found so far;
  // among leaves that may meet at once, those with the smallest features first. Bodies that rest against each other
  // have thousands of leaves and contacts at t = 0, of which a few batches find the one to report.
  ContactRows search_part(std::vector<double> horizon, size_t most_at_start) {
    traversal_.horizon = horizon.data();
    if (wants_first(narrow_.report)) narrow_.latest = horizon.data();
    FoundLeaves found = find_leaf_pairs(executor_, bodies_, traversal_, most_at_start);
    counts_[kNodeTests] += found.node_tests;
    std::vector<Wanted> left;
    left.reserve(found.pairs.size());
    for (LeafPair& leaves : found.pairs) {
      // From a part of the time searched to a part of the step, rounded down.
      if (const double until = horizon_of(traversal_, leaves.pair); until < 1.0) {
        leaves.begin = (1.0f - 4.0f * Precision<float>::unit) * static_cast<float>(leaves.begin * until);
      }
      left.push_back({leaves, 0});
    }
    if (most_at_start != kAllLeaves) {
      for_each_pair(left, [&](size_t begin, size_t end) {
        if (end - begin >= most_at_start) ended_early_.push_back(left[begin].leaves.pair);
      });
    }
    order(left);
    ContactRows best;
    for (size_t most = kFirstBatch; !left.empty(); most *= 4) {
      const std::vector<LeafPair> batch = take_batch(left, most, most == kFirstBatch);
      const CandidateList listed = visit_leaf_pairs(executor_, bodies_, traversal_, batch, most == kFirstBatch);
      best = first_of_each_pair(best, solve(listed), horizon);
      std::vector<FirstFeature> known(traversal_.pair_count, kNoFeature);
      for (size_t row = 0; row < best.pair.size(); ++row) {
        const int32_t pair = best.pair[row];
        horizon[pair] = best.toi[row];
        // Of contacts at the same time, that of the smallest features is the first.
        if (best.toi[row] == 0.0) {
          known[pair] = first_feature(static_cast<FeatureKind>(best.kind[row]), best.features[2 * row]);
        }
        if (narrow_.report == Report::kAny) known[pair] = -1;
      }
      std::erase_if(left, [&](const Wanted& w) {
        const double latest = horizon[w.leaves.pair];
        return w.leaves.begin > latest || w.first > known[w.leaves.pair];
      });
    }
    traversal_.horizon = narrow_.latest = nullptr;
    return best;
  }

  // Leaf pairs still to be searched, by body pair.
  struct Wanted {
    LeafPair leaves;
    FirstFeature first;  // of their candidates, at least
  };

  // Some contact of each pair. Descents that ended early without a contact are repeated.
  ContactRows search_any() {
    const auto until_end = [](size_t pairs) { return std::vector<double>(pairs, 1.0); };
    ContactRows found = search_until(until_end(traversal_.pair_count), kFewAtStart);
    std::vector<char> is_decided(traversal_.pair_count);
    for (const int32_t pair : found.pair) is_decided[pair] = 1;
    std::erase_if(ended_early_, [&](int32_t pair) { return is_decided[pair] != 0; });
    if (ended_early_.empty()) return found;
    append_rows(found,
                of_pairs(ended_early_, [&] { return search_until(until_end(ended_early_.size()), kAllLeaves); }));
    return by_pair_until(found, std::numeric_limits<double>::infinity());
  }

  // Calls use(begin, end) for the leaf pairs of each body pair.
  template <class Use>
  static void for_each_pair(const std::vector<Wanted>& wanted, Use&& use) {
    for (size_t begin = 0, end; begin < wanted.size(); begin = end) {
      end = begin;
      while (end < wanted.size() && wanted[end].leaves.pair == wanted[begin].leaves.pair) ++end;
      use(begin, end);
    }
  }

  // Sorts the leaf pairs of each body pair by time, and many also by feature.
  void order(std::vector<Wanted>& wanted) const {
    for_each_pair(wanted, [&](size_t begin, size_t end) {
      const auto first = wanted.begin() + begin, last = wanted.begin() + end;
      if (end - begin > kFirstBatch) {
        std::for_each(first, last, [&](Wanted& w) {
          w.first = first_feature_of(bodies_, traversal_.pairs + 2 * int64_t{w.leaves.pair}, w.leaves.leaves);
        });
      }
      std::sort(first, last, [](const Wanted& a, const Wanted& b) {
        return std::tie(a.leaves.begin, a.first) < std::tie(b.leaves.begin, b.first);
      });
    });
  }

  // Removes up to `most` leaf pairs of each body pair; of those that may meet first only, if so wanted.
  static std::vector<LeafPair> take_batch(std::vector<Wanted>& wanted, size_t most, bool only_first) {
    std::vector<LeafPair> batch;
    std::vector<Wanted> rest;
    for_each_pair(wanted, [&](size_t begin, size_t end) {
      for (size_t k = begin; k < end; ++k) {
        const bool is_taken = k < begin + most && (!only_first || wanted[k].leaves.begin == wanted[begin].leaves.begin);
        is_taken ? batch.push_back(wanted[k].leaves) : rest.push_back(wanted[k]);
      }
    });
    wanted.swap(rest);
    return batch;
  }

  // The earliest contact of the scene, and those at the same time of pairs before it. Every batch of pairs, of doubling
  // sizes, is searched until the earliest contact of those before; pairs that are likely to touch early come first.
  ContactRows search_earliest() {
    std::vector<int32_t> order = likely_order(traversal_);
    ContactRows found;
    double earliest = std::numeric_limits<double>::infinity();
    for (size_t begin = 0, size = 1; begin < order.size(); begin += size, size *= 2) {
      size = std::min(size, order.size() - begin);
      const ContactRows rows = of_pairs({order.data() + begin, size}, [&] {
        return search_until(std::vector<double>(size, smaller(earliest, 1.0)), kAllLeaves);
      });
      for (const double toi : rows.toi) earliest = smaller(earliest, toi);
      append_rows(found, rows);
      if (earliest > 0.0) continue;
      // Of contacts at t = 0, that of the first pair is the earliest.
      int32_t first = std::numeric_limits<int32_t>::max();
      for (size_t row = 0; row < found.pair.size(); ++row) {
        if (found.toi[row] == 0.0) first = smaller(first, found.pair[row]);
      }
      order.erase(std::remove_if(order.begin() + begin + size, order.end(), [&](int32_t row) { return row > first; }),
                  order.end());
    }
    return by_pair_until(found, earliest);
  }

  // Indices of all pairs by the estimated time of contact; bodies against themselves come last. Only affects how much
  // is searched.
  std::vector<int32_t> likely_order(const TraverseInput& input) const {
    std::vector<double> estimate(input.pair_count);
    for (int64_t pair = 0; pair < input.pair_count; ++pair) {
      const int64_t i = input.pairs[2 * pair], j = input.pairs[2 * pair + 1];
      const bool are_there = is_within(i, bodies_.centres.count) && is_within(j, bodies_.centres.count);
      estimate[pair] = !are_there || i == j ? 2.0 : time_when_near(bodies_.centres, i, j);
    }
    std::vector<int32_t> order(input.pair_count);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int32_t a, int32_t b) { return estimate[a] < estimate[b]; });
    return order;
  }

  // The time, as part of the step, at which spheres of half the bodies' radii meet; 1 if they do not.
  static double time_when_near(const BodyCentres& centres, int64_t i, int64_t j) {
    const auto offset = [&](const double* position) {
      return load_vec3(position + 3 * j) - load_vec3(position + 3 * i);
    };
    const Vec3<double> start = offset(centres.position_t0), change = offset(centres.position_t1) - start;
    const double reach = 0.5 * (centres.radius[i] + centres.radius[j]);
    const double beyond = norm_squared(start) - reach * reach, approach = -dot(start, change);
    if (!(beyond > 0.0)) return 0.0;
    const double discriminant = approach * approach - norm_squared(change) * beyond;
    if (!(approach > 0.0) || !(discriminant >= 0.0)) return 1.0;
    return smaller(beyond / (approach + std::sqrt(discriminant)), 1.0);
  }

  ContactRows solve(const CandidateList& list) {
    std::vector<Candidate> candidates;
    candidates.reserve(list.size());
    for (const auto& part : list.parts) candidates.insert(candidates.end(), part.begin(), part.end());
    counts_[kCandidatesNeeded] += list.size();
    const int64_t start = host_nanoseconds();
    NarrowInput narrow = narrow_;
    narrow.candidates = {candidates.data(), list.size()};
    ContactRows found = solve_candidates(executor_, bodies_, narrow);
    narrow_time_ += host_nanoseconds() - start;
    return found;
  }

  const Executor& executor_;
  const Bodies& bodies_;
  TraverseInput traversal_;
  NarrowInput narrow_;
  int64_t* counts_;
  std::vector<int32_t> ended_early_;  // pairs whose descent may have ended early
  int64_t narrow_time_ = 0;
};

// Contacts of the valid pairs. Sets all counts except those of rows written.
template <class Bodies>
ContactRows search_all(const Executor& executor, const Bodies& bodies, const ContactSearch& search) {
  int64_t* const counts = search.traverse_counts;
  const int64_t began = counts[kTraverseBegan];
  std::fill_n(counts, int64_t{kTraverseCounts}, int64_t{0});
  std::fill_n(search.contact_counts, int64_t{kContactCounts}, int64_t{0});
  counts[kTraverseBegan] = began;
  PairSearch<Bodies> pairs(executor, bodies, search);
  ContactRows found = pairs.search();
  search.contact_counts[kContactsNeeded] = static_cast<int64_t>(found.pair.size());
  search.contact_counts[kNarrowEnded] = host_nanoseconds();
  counts[kTraverseEnded] = search.contact_counts[kNarrowEnded] - pairs.narrow_time();
  return found;
}

}  // namespace

void begin_counts(const Executor&, const CountSpan& first, const CountSpan& second, int64_t* time) {
  *time = host_nanoseconds();
  for (const CountSpan& span : {first, second}) std::copy_n(span.from, span.count, span.to);
}

template <class Bodies>
void find_contacts(const Executor& executor, const Bodies& bodies, const ContactSearch& search,
                   const ContactOutput& make_output) {
  const ContactRows found = search_all(executor, bodies, search);
  const int64_t rows = static_cast<int64_t>(found.pair.size()), given = search.contact_capacity.contacts;
  const int64_t most = given == kExactly ? rows : given, written = std::min(rows, most);
  const ContactColumns out = make_output(most);
  copy_contacts(found, written, out);
  for (int64_t row = 0; row < written; ++row) {
    std::copy_n(search.narrow.pairs + 2 * int64_t{found.pair[row]}, 2, out.bodies + 2 * row);
  }
  for (int64_t row = written; row < most; ++row) pad_row(out, row);
  search.contact_counts[kContactsOverflow] = rows > most;
  search.contact_counts[kUnresolvedWritten] =
      std::count(found.status.begin(), found.status.begin() + written, static_cast<int8_t>(Status::kUnresolved));
}

void lower_first_toi(const Executor& executor, const RigidBodies& bodies, const ContactSearch& search,
                     const FirstToi& known) {
  require_rows(executor, std::clamp<int64_t>(*search.pair_count, 0, search.narrow.pair_count), "owners",
               "name rows of first", [&](int64_t pair) {
                 return is_within(known.owners[2 * pair], known.count) &&
                        is_within(known.owners[2 * pair + 1], known.count);
               });
  const ContactRows found = search_all(executor, bodies, search);
  for (size_t row = 0; row < found.pair.size(); ++row) {
    for (int side = 0; side < 2; ++side) {
      double& first = known.first[known.owners[2 * int64_t{found.pair[row]} + side]];
      first = smaller(first, found.toi[row]);
    }
  }
}

template void find_contacts(const Executor&, const RigidBodies&, const ContactSearch&, const ContactOutput&);
template void find_contacts(const Executor&, const DeformingBodies&, const ContactSearch&, const ContactOutput&);

}  // namespace pgccd
