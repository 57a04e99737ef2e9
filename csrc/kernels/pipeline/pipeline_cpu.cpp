#include <algorithm>
#include <chrono>

#include "kernels/pipeline/pipeline.h"
#include "kernels/traverse/leaf_separation.h"

namespace pgccd {
namespace {

int64_t nanoseconds() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
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

  // Folded surfaces have many leaf pairs that may meet from the start, so that parts save nothing.
  bool has_self_pairs() const {
    const int64_t* const pairs = traversal_.pairs;
    for (int64_t pair = 0; pair < traversal_.pair_count; ++pair) {
      if (pairs[2 * pair] == pairs[2 * pair + 1]) return true;
    }
    return false;
  }

  ContactRows search_at_once() {
    const CandidateList list = traverse_cpu(executor_, bodies_, traversal_);
    counts_[kNodeTests] += list.node_tests;
    return solve(list);
  }

  // The first contact of each pair, in two parts: the leaves that may meet first, then those of the others that may
  // meet before the contacts found, over the motion until then. With `only_earliest`, until the earliest of all.
  ContactRows search_in_parts(bool only_earliest) {
    const FoundLeaves found = find_leaf_pairs_cpu(executor_, bodies_, traversal_);
    counts_[kNodeTests] += found.node_tests;
    std::vector<float> earliest(traversal_.pair_count, kNeverMeet);
    for (const LeafPair& leaves : found.pairs) earliest[leaves.pair] = smaller(earliest[leaves.pair], leaves.begin);
    std::vector<LeafPair> first, later;
    for (const LeafPair& leaves : found.pairs) {
      (leaves.begin == earliest[leaves.pair] ? first : later).push_back(leaves);
    }
    const ContactRows guess = solve(visit_leaf_pairs_cpu(executor_, bodies_, traversal_, first));

    std::vector<double> horizon(traversal_.pair_count, 1.0);
    for (size_t row = 0; row < guess.pair.size(); ++row) horizon[guess.pair[row]] = guess.toi[row];
    if (only_earliest && !horizon.empty()) {
      std::fill(horizon.begin(), horizon.end(), *std::min_element(horizon.begin(), horizon.end()));
    }
    std::erase_if(later, [&](const LeafPair& leaves) { return leaves.begin > horizon[leaves.pair]; });
    traversal_.horizon = narrow_.latest = horizon.data();
    const ContactRows rest = solve(visit_leaf_pairs_cpu(executor_, bodies_, traversal_, later));
    traversal_.horizon = narrow_.latest = nullptr;
    return first_of_each_pair(guess, rest, horizon);
  }

 private:
  ContactRows solve(const CandidateList& list) {
    std::vector<Candidate> candidates;
    candidates.reserve(list.size());
    for (const auto& part : list.parts) candidates.insert(candidates.end(), part.begin(), part.end());
    counts_[kCandidatesNeeded] += list.size();
    const int64_t start = nanoseconds();
    NarrowInput narrow = narrow_;
    narrow.candidates = {candidates.data(), list.size()};
    ContactRows found = narrow_phase_cpu(executor_, bodies_, narrow);
    narrow_time_ += nanoseconds() - start;
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
  const bool in_parts = search.narrow.report == Report::kFirst && !pairs.has_self_pairs();
  ContactRows found = in_parts ? pairs.search_in_parts(search.only_earliest) : pairs.search_at_once();
  search.contact_counts[kContactsNeeded] = static_cast<int64_t>(found.pair.size());
  search.contact_counts[kNarrowEnded] = nanoseconds();
  counts[kTraverseEnded] = search.contact_counts[kNarrowEnded] - pairs.narrow_time();
  return found;
}

void count_pairs(int64_t began, int64_t found, int64_t written, int64_t* counts) {
  counts[kPairsNeeded] = found;
  counts[kOverlapsNeeded] = counts[kLongRowsNeeded] = 0;
  counts[kPairsWritten] = written;
  counts[kPairsOverflow] = found > written;
  counts[kBroadBegan] = began;
  counts[kBroadEnded] = nanoseconds();
}

}  // namespace

void begin_counts_cpu(const CountSpan& first, const CountSpan& second, int64_t* time) {
  *time = nanoseconds();
  for (const CountSpan& span : {first, second}) std::copy_n(span.from, span.count, span.to);
}

void find_pairs_padded_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                           const PaddedPairs& out) {
  const int64_t began = nanoseconds(), capacity = out.capacity.pairs;
  std::vector<int64_t> too_many;
  int64_t count = 0;
  const auto make_output = [&](int64_t found) {
    count = found;
    if (found <= capacity) return out.rows;
    too_many.resize(2 * found);
    return too_many.data();
  };
  if (!bodies.invalid()) find_pairs_cpu(executor, bodies, choice, make_output);
  const int64_t written = std::min(count, capacity);
  if (!too_many.empty()) std::copy_n(too_many.data(), 2 * written, out.rows);
  std::fill(out.rows + 2 * written, out.rows + 2 * capacity, int64_t{-1});
  count_pairs(began, count, written, out.counts);
}

void find_pairs_exactly_cpu(const Executor& executor, const BroadBodies& bodies, const BroadPhaseChoice& choice,
                            int64_t most, const PairOutput& make_output, int64_t* counts) {
  const int64_t began = nanoseconds();
  std::vector<int64_t> too_many;
  int64_t count = 0;
  const auto rows = [&](int64_t found) {
    count = found;
    if (found <= most) return make_output(found);
    make_output(0);
    too_many.resize(2 * found);
    return too_many.data();
  };
  if (bodies.invalid()) {
    make_output(0);
  } else {
    find_pairs_cpu(executor, bodies, choice, rows);
  }
  count_pairs(began, count, count <= most ? count : 0, counts);
}

template <class Bodies>
void find_contacts_cpu(const Executor& executor, const Bodies& bodies, const ContactSearch& search,
                       const ContactOutput& make_output) {
  const ContactRows found = search_all(executor, bodies, search);
  const int64_t rows = static_cast<int64_t>(found.pair.size()), given = search.contact_capacity.contacts;
  const int64_t most = given == kExactly ? rows : given, written = std::min(rows, most);
  const ContactColumns out = make_output(most);
  copy_rows(found, written, out);
  for (int64_t row = 0; row < written; ++row) {
    std::copy_n(search.narrow.pairs + 2 * int64_t{found.pair[row]}, 2, out.bodies + 2 * row);
  }
  for (int64_t row = written; row < most; ++row) pad_row(out, row);
  search.contact_counts[kContactsOverflow] = rows > most;
  search.contact_counts[kUnresolvedWritten] =
      std::count(found.status.begin(), found.status.begin() + written, static_cast<int8_t>(Status::kUnresolved));
}

void lower_first_toi_cpu(const Executor& executor, const RigidBodies& bodies, const ContactSearch& search,
                         const FirstToi& known) {
  const ContactRows found = search_all(executor, bodies, search);
  for (size_t row = 0; row < found.pair.size(); ++row) {
    for (int side = 0; side < 2; ++side) {
      double& first = known.first[known.owners[2 * int64_t{found.pair[row]} + side]];
      first = smaller(first, found.toi[row]);
    }
  }
}

template void find_contacts_cpu(const Executor&, const RigidBodies&, const ContactSearch&, const ContactOutput&);
template void find_contacts_cpu(const Executor&, const DeformingBodies&, const ContactSearch&, const ContactOutput&);

}  // namespace pgccd
