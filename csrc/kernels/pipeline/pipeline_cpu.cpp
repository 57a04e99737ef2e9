#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <tuple>

#include "kernels/pipeline/pipeline.h"
#include "kernels/traverse/leaf_separation.h"

namespace pgccd {
namespace {

// A kind and the feature of the first body, in the order of contacts.
using FirstFeature = int64_t;
constexpr FirstFeature kNoFeature = std::numeric_limits<FirstFeature>::max();
FirstFeature first_feature(FeatureKind kind, int32_t feature_i) { return static_cast<int64_t>(kind) << 32 | feature_i; }

// A lower bound of that of all candidates of a pair of leaves.
template <class Bodies>
FirstFeature first_feature_of(const Bodies& bodies, const TraverseInput& input, const LeafPair& item) {
  const int64_t *const pair = input.pairs + 2 * int64_t{item.pair}, sides = pair[0] == pair[1] ? 2 : 1;
  const int32_t node[2] = {item.leaves.first, item.leaves.second};
  int32_t first = std::numeric_limits<int32_t>::max();
  for (int side = 0; side < sides; ++side) {
    const MeshOffsets& offsets = bodies.meshes.offsets[bodies.mesh_index[pair[side]]];
    const NodeLink leaf = bodies.meshes.node_links[kBlockWidth * offsets.block + node[side]];
    const Triangle* const triangles = bodies.meshes.triangles + offsets.face + leaf.first;
    for (int k = 0; k < leaf.triangle_count; ++k) {
      for (int c = 0; c < 3; ++c) {
        if (triangles[k].represented >> c & 1) first = std::min(first, triangles[k].vertex[c]);
      }
    }
  }
  const bool has_vertex = first != std::numeric_limits<int32_t>::max();
  return has_vertex ? first_feature(FeatureKind::kVertexFace, first) : first_feature(FeatureKind::kFaceVertex, 0);
}

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
    if (narrow_.report == Report::kEarliest) return search_earliest();
    return search_until(std::vector<double>(traversal_.pair_count, 1.0));
  }

 private:
  ContactRows search_at_once() {
    const CandidateList list = list_candidates(executor_, bodies_, traversal_);
    counts_[kNodeTests] += list.node_tests;
    return solve(list);
  }

  // One contact of each pair until a time: the first one, unless any will do. Leaves are searched in batches, first
  // those that may meet first, over the motion until the contacts found so far; among leaves that may meet at once,
  // those with the smallest features first. Bodies that rest against each other have thousands of leaves and contacts
  // at t = 0, of which a few batches find the one to report.
  ContactRows search_until(std::vector<double> horizon) {
    traversal_.horizon = horizon.data();
    if (wants_first(narrow_.report)) narrow_.latest = horizon.data();
    FoundLeaves found = find_leaf_pairs(executor_, bodies_, traversal_);
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
    order(left);
    ContactRows best;
    for (size_t most = kFirstBatch; !left.empty(); most *= 4) {
      const std::vector<LeafPair> batch = take_batch(left, most, most == kFirstBatch);
      best = first_of_each_pair(best, solve(visit_leaf_pairs(executor_, bodies_, traversal_, batch)), horizon);
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

  // Leaf pairs of a body pair in the first batch; those of most pairs fit into it.
  static constexpr size_t kFirstBatch = 4;

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
        std::for_each(first, last, [&](Wanted& w) { w.first = first_feature_of(bodies_, traversal_, w.leaves); });
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

  // The earliest contact of the scene, and those at the same time. Every batch of pairs, of doubling sizes, is searched
  // until the earliest contact of those before; pairs that are likely to touch early come first.
  ContactRows search_earliest() {
    const TraverseInput all = traversal_;
    const std::vector<int32_t> order = likely_order(all);
    std::vector<int64_t> pairs;
    pairs.reserve(2 * order.size());
    for (const int32_t row : order) pairs.insert(pairs.end(), {all.pairs[2 * row], all.pairs[2 * row + 1]});
    ContactRows found;
    double earliest = std::numeric_limits<double>::infinity();
    for (int64_t begin = 0, size = 1; begin < all.pair_count; begin += size, size *= 2) {
      size = std::min(size, all.pair_count - begin);
      traversal_.pairs = narrow_.pairs = pairs.data() + 2 * begin;
      traversal_.pair_count = narrow_.pair_count = size;
      ContactRows rows = search_until(std::vector<double>(size, smaller(earliest, 1.0)));
      for (int32_t& pair : rows.pair) pair = order[begin + pair];
      for (const double toi : rows.toi) earliest = smaller(earliest, toi);
      append_rows(found, rows);
    }
    traversal_.pairs = narrow_.pairs = all.pairs;
    traversal_.pair_count = narrow_.pair_count = all.pair_count;
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
