// The launches of the traversal. All lists have given capacities and are counted on the device, without synchronising;
// the counts then show whether everything fit.
#include <cub/cub.cuh>

#include "core/enclosures.h"
#include "kernels/launch.cuh"
#include "kernels/traverse/cull_leaves.cuh"
#include "kernels/traverse/descend.cuh"
#include "kernels/traverse/place_pairs.cuh"
#include "kernels/traverse/traverse.h"
#include "kernels/traverse/traverse_counters.h"
#include "kernels/traverse/visit_leaves.cuh"
#include "kernels/traverse/visit_starts.cuh"
#include "kernels/warp_share.cuh"

namespace pgccd {
namespace {

// Number of waves of blocks: kernels of other streams, of any priority, can only start between waves. Four waves do not
// measurably slow down a search.
constexpr int kWaves = 4;

// The number of blocks for at most as many threads: up to kWaves waves, and at least one, so that every multiprocessor
// takes part. One, if the kernel takes only a share of the device.
template <class Kernel>
unsigned blocks_in_waves(const DeviceContext& context, Kernel kernel, int64_t most_threads) {
  const int resident = resident_blocks_of(context, kernel);
  const int64_t waves = most_threads / (int64_t{resident} * kBlockThreads) + 1;
  return static_cast<unsigned>(resident * smaller<int64_t>(waves, context.share == 1 ? kWaves : 1));
}

// With fewer body pairs, two parts take longer than one: every launch has a minimum duration.
constexpr int64_t kManyPairs = 1 << 18;

// Enough for the standard scene, see Traversal::enqueue.
constexpr int64_t kLaunches = 4;

constexpr const char* kUnsoundPairs =
    "pairs: a row names a body that is not there; or the body a mesh, vertices or node blocks that are not there";
constexpr const char* kTooMuchForOneCall = "pairs: need more than 2^31 rows on the way; give fewer in one call";

// Number of vertices of the bodies that may be tested against themselves.
int64_t deforming_vertices(const RigidBodies&) { return 0; }
int64_t deforming_vertices(const DeformingBodies& bodies) { return bodies.vertex_count; }

// Twice what the standard scene needs; and for bodies tested against themselves, up to a size, about ten pairs of
// leaves and as many candidates per vertex of folded cloth.
TraverseListSizes guess_sizes(const TraverseInput& input, int64_t vertex_count) {
  const auto sum = [&](int64_t each_pair, int64_t each_vertex = 0) {
    return rows_of(each_pair * input.pair_count + 65536 +
                   smaller<int64_t>(each_vertex * vertex_count, int64_t{1} << 22));
  };
  return {sum(1), sum(1, 4), sum(16, 16), sum(12, 24)};
}

template <class Bodies, class Select, class Fn>
__global__ void __launch_bounds__(kBlockThreads) for_selected_pairs(Pairs<Bodies> pairs, Select is_selected, Fn fn) {
  wait_for_previous_kernels();
  __shared__ WaitingItems waiting[kWarpsPerBlock];
  for_each_selected(0, pairs.count(), waiting[threadIdx.x / kWarp], is_selected, fn);
}

// All public, since device lambdas are not allowed in private members.
template <class Bodies>
struct Traversal {
  using Sweep = SweepOf<Bodies>;

  // `count`: of the pairs, on the device; null if that is all of the input's. `crowded`: as of TraverseCapacity; then
  // time is divided too.
  Traversal(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input, const int64_t* count,
            bool crowded)
      : context_(context),
        bodies_(bodies),
        input_(input),
        crowded_(crowded),
        counters_(context.allocate<TraverseCounters>(1)) {
    input_.settings.divides_time = crowded;
    sweeps_ = context.allocate<Sweep>(input.pair_count);
    pose_begin_ = context.allocate<uint32_t>(input.pair_count);
    pairs_ = {bodies,
              sweeps_,
              nullptr,
              pose_begin_,
              count != nullptr ? count : count_on_device(),
              input.pair_count,
              &counters_->poses,
              &counters_->unsound,
              0};
    const int64_t most_self_pairs = Sweep::may_be_one_body ? input.pair_count : 0;
    self_pairs_ = {&counters_->self_pairs, &counters_->self_blocks, context.allocate<uint32_t>(most_self_pairs),
                   context.allocate<int32_t>(most_self_pairs), most_self_pairs};
  }

  int64_t* count_on_device() {
    int64_t* on_device = context_.allocate<int64_t>(1);
    const int64_t count = input_.pair_count;
    for_each_item(context_, 1, [=] __device__(int64_t) { *on_device = count; });
    return on_device;
  }

  // Does not synchronise; overflow is counted. `launches`: of the descent after the first one; each continues tasks
  // that warps have returned. `search`: null if all candidates are listed at once.
  CandidateSink enqueue(const TraverseListSizes& capacity, int64_t launches, const SearchFirstPart& search) {
    CandidateSink out;
    const LeafPairList leaves = start(capacity, out);
    list_enclosures(out);
    for (int launch = 0; launch <= launches; ++launch) descend_once(launch, launch == launches, leaves);
    if (search) {
      visit_in_order(leaves, out, search);
    } else {
      const LeafPairList meeting = cull(leaves, new_list(&counters_->meeting_leaves, leaves), nullptr, {});
      visit_at_start(meeting, out);
      visit(meeting, out);
    }
    return out;
  }

  // First leaf pairs that begin first in their body pair; then those of the others that may meet before the contact
  // found in these.
  void visit_in_order(LeafPairList leaves, CandidateSink out, const SearchFirstPart& search) {
    const int64_t pair_count = input_.pair_count;
    uint32_t *earliest = context_.allocate<uint32_t>(pair_count), *counts = nullptr;
    fill_bytes(context_, earliest, 0xff, pair_count);
    const LeafPairList meeting = cull(leaves, new_list(&counters_->meeting_leaves, leaves), earliest, {});
    const LeafPairList first{leaves.items, &counters_->first_leaves, leaves.capacity};  // in memory no longer needed
    const LeafPairList later = new_list(&counters_->later_leaves, leaves);
    if (crowded_) {
      counts = context_.allocate<uint32_t>(pair_count);
      fill_bytes(context_, counts, 0, pair_count);
      count_first_leaves(context_, meeting, earliest, counts);
    }
    launch_kernel(context_, split_by_begin, resident_blocks_of(context_, split_by_begin), kBlockThreads, meeting,
                  earliest, counts, first, later);
    visit_at_start(first, out);
    visit(first, out);
    TraverseCounters* counters = counters_;
    for_each_item(context_, 1, [=] __device__(int64_t) { counters->search_time = -nanoseconds(); });
    const FirstPart found = search(span(out, &counters_->no_candidates));
    for_each_item(context_, 1, [=] __device__(int64_t) {
      counters->search_time += nanoseconds();
      counters->searched_candidates = counters->candidates;
    });
    shorten(found.toi);
    const LeafPairList remaining =
        cull(later, {meeting.items, &counters_->remaining_leaves, leaves.capacity}, nullptr, found);
    if (crowded_) visit_at_start(remaining, out);  // otherwise all of them begin later than at the start
    visit(remaining, out);
  }

  CandidateSpan span(CandidateSink out, const CandidateCounts* before) {
    return {out.items, out.capacity, out.counts, before};
  }

  LeafPairList new_list(Counter* count, LeafPairList as_large_as) {
    return {context_.allocate<LeafPair>(as_large_as.capacity), count, as_large_as.capacity};
  }

  // Repeats the traversal with larger capacities until everything fits.
  TraverseCounters run(CandidateSink& out) {
    TraverseListSizes capacity = guess_sizes(input_, deforming_vertices(bodies_));
    for (int64_t launches = kLaunches;; launches *= 2) {
      out = enqueue(capacity, launches, nullptr);
      TraverseCounters seen = read(context_, counters_);
      if (seen.unsound != 0) throw std::runtime_error(kUnsoundPairs);
      const Counter left = seen.rest[rest_after(launches)];
      seen.most_rest = larger(seen.most_rest, left);
      if (capacity.holds(seen) && left == 0) return seen;
      if (!capacity.can_grow(seen)) throw std::runtime_error(kTooMuchForOneCall);
      capacity.grow(seen);
    }
  }

  CandidateSpan run_padded(const TraverseCapacity& given, int64_t* counts, const SearchFirstPart& search) {
    const TraverseListSizes capacity{rows_of(larger<int64_t>(given.poses, kStoredSegments + 1)), rows_of(given.tasks),
                                     rows_of(given.leaf_pairs), rows_of(given.candidates)};
    const bool in_parts = search && (crowded_ || input_.pair_count >= kManyPairs);
    const bool is_crowded = crowded_, wants_few = static_cast<bool>(search);
    const Pairs<Bodies> pairs = pairs_;
    const CandidateSink out = enqueue(capacity, given.launches, in_parts ? search : nullptr);
    const TraverseCounters* seen = counters_;
    const int last = rest_after(given.launches);
    for_each_item(context_, 1, [=] __device__(int64_t) {
      store_traverse_counts(*seen, capacity, last, counts);
      // On average, each body pair has more candidates than a first part needs leaves; and these are too many, or many
      // because bodies turn fast.
      const Counter found = seen->candidates.sum();
      const bool is_too_many = wants_few && !fits(found, capacity.candidates);
      const bool has_many = found / kFirstLeaves > static_cast<Counter>(pairs.given());
      counts[kCrowded] = !is_crowded && has_many && (is_too_many || seen->has_fast_pairs != 0) ? 1 : 0;
      counts[kTraverseEnded] = nanoseconds() - seen->search_time;
    });
    return span(out, in_parts ? &counters_->searched_candidates : &counters_->no_candidates);
  }

  LeafPairList start(const TraverseListSizes& capacity, CandidateSink& out) {
    fill_bytes(context_, counters_, 0, 1);
    out = {context_.allocate<Candidate>(capacity.candidates), &counters_->candidates, capacity.candidates};
    const LeafPairList leaves{context_.allocate<LeafPair>(capacity.leaves), &counters_->leaves, capacity.leaves};
    task_capacity_ = capacity.tasks;
    for (Task*& tasks : tasks_) tasks = context_.allocate<Task>(capacity.tasks);
    start_pairs(capacity.poses, leaves);
    return leaves;
  }

  void start_pairs(uint32_t pose_capacity, LeafPairList leaves) {
    LocalPose* poses = context_.allocate<LocalPose>(kPosesAtHand * input_.pair_count + pose_capacity);
    pairs_.poses = poses;
    pairs_.pose_capacity = pose_capacity;
    const TaskList roots = tasks_before(0);
    const PlacedPairs<Bodies> placed{sweeps_, poses, pose_begin_, roots, leaves, self_pairs_};
    const int64_t blocks = (input_.pair_count + kBlockThreads - 1) / kBlockThreads;
    with_division([&]<bool kDividesTime>() {
      const auto kernel = place_pairs<kDividesTime, Bodies>;
      launch_kernel(context_, kernel,
                    static_cast<unsigned>(smaller<int64_t>(blocks, resident_blocks_of(context_, kernel))),
                    kBlockThreads, pairs_, input_, placed, counters_);
    });
    if constexpr (Sweep::may_be_one_body) {
      launch_kernel(context_, start_self_pairs<Bodies>, resident_blocks_of(context_, start_self_pairs<Bodies>),
                    kBlockThreads, pairs_, self_pairs_, leaves, roots, &counters_->node_tests);
    }
  }

  // Sweeps and poses of the pairs of which a contact was found, until its toi. The descent, which has ended, is the
  // only one to read the first poses of pairs with several segments.
  void shorten(const unsigned long long* toi) {
    const Pairs<Bodies> pairs = pairs_;
    const TraverseInput input = input_;
    Sweep* sweeps = sweeps_;
    auto* poses = const_cast<LocalPose*>(pairs_.poses);
    const auto has_contact = [=] __device__(uint32_t pair) { return toi[pair] != ~0ull; };
    const auto shorten_pair = [=] __device__(uint32_t pair) {
      const double horizon = __longlong_as_double(static_cast<long long>(toi[pair]));
      // A shorter motion has no more segments. A pair without rows for all poses remains one.
      const int least_segments = sweeps[pair].turns_fast() ? kStoredSegments + 1 : 1;
      const Sweep sweep(pairs.bodies, input.pairs[2 * int64_t{pair}], input.pairs[2 * int64_t{pair} + 1],
                        input.settings, horizon, least_segments);
      for (int k = 0; k <= sweep.last_pose(); ++k) {
        store_words(sweep.pose(pairs.bodies, k), poses[pairs.pose_begin[pair] + k]);
      }
      store_words(sweep, sweeps[pair]);
    };
    const auto kernel = for_selected_pairs<Bodies, decltype(has_contact), decltype(shorten_pair)>;
    launch_kernel(context_, kernel, resident_blocks_of(context_, kernel), kBlockThreads, pairs, has_contact,
                  shorten_pair);
  }

  // Tasks of a launch of the descent: of the first the roots, of others what the launch before left over.
  TaskList tasks_before(int launch) { return {tasks_[launch % 2], &counters_->rest[launch % 3], task_capacity_}; }

  // The index in `rest` of what the last launch leaves over.
  static int rest_after(int64_t last_launch) { return static_cast<int>((last_launch + 1) % 3); }

  void descend_once(int launch, bool is_last, LeafPairList leaves) {
    const int next = (launch + 2) % 3;
    const TaskHandover tasks{tasks_before(launch),
                             tasks_before(launch + 1),
                             &counters_->taken[launch % 3],
                             &counters_->rest[next],
                             &counters_->taken[(launch + 1) % 3],
                             &counters_->most_rest};
    with_division([&]<bool kDividesTime>() {
      const auto kernel = descend<kDividesTime, Bodies>;
      const unsigned blocks = launch == 0 ? blocks_in_waves(context_, kernel, kBlockWidth * input_.pair_count)
                                          : resident_blocks_of(context_, kernel);
      launch_kernel(context_, kernel, blocks, kBlockThreads, pairs_, is_last ? kLastLaunch : launch, tasks, leaves,
                    &counters_->node_tests);
    });
  }

  // Vertices that may be inside of a solid.
  void list_enclosures(CandidateSink out) {
    if (bodies_.meshes.solids.is_solid == nullptr || !input_.settings.tests_start) return;
    const Pairs<Bodies> pairs = pairs_;
    const int64_t* rows = input_.pairs;
    for_each_item(context_, input_.pair_count, [=] __device__(int64_t row) {
      if (row >= pairs.count()) return;
      for_each_enclosure(pairs.bodies, rows, row, [&](const Candidate& candidate) {
        out.put(false, warp_append(&out.counts->back), candidate);
      });
    });
  }

  // Calls launch with whether time is divided, as a constant.
  template <class Launch>
  void with_division(const Launch& launch) const {
    if constexpr (Sweep::may_turn_fast) {
      if (input_.settings.divides_time) return launch.template operator()<true>();
    }
    launch.template operator()<false>();
  }

  LeafPairList cull(LeafPairList leaves, LeafPairList meeting, EarliestBegins earliest, const FirstPart& found) {
    with_division([&]<bool kDividesTime>() {
      const auto kernel = cull_leaves<kDividesTime, Bodies>;
      launch_kernel(context_, kernel, blocks_in_waves(context_, kernel, leaves.capacity), kBlockThreads, pairs_, leaves,
                    meeting, earliest, found);
    });
    return meeting;
  }

  void visit(LeafPairList leaves, CandidateSink out) {
    with_division([&]<bool kDividesTime>() {
      const auto kernel = visit_leaves<kDividesTime, Bodies>;
      launch_kernel(context_, kernel, blocks_in_waves(context_, kernel, int64_t{kWarp / 2} * leaves.capacity),
                    kBlockThreads, pairs_, leaves, out);
    });
  }

  // Leaf pairs that may be near at t = 0: the first to be visited, if not all are visited at once.
  void visit_at_start(LeafPairList leaves, CandidateSink out) {
    if (!input_.settings.tests_start) return;
    launch_kernel(context_, visit_starts<Bodies>,
                  blocks_in_waves(context_, visit_starts<Bodies>, int64_t{kMaxLeafTriangles} * leaves.capacity),
                  kBlockThreads, pairs_, leaves, out);
  }

  const DeviceContext& context_;
  const Bodies& bodies_;
  TraverseInput input_;
  const bool crowded_;
  TraverseCounters* counters_;
  Sweep* sweeps_;
  uint32_t* pose_begin_;
  Pairs<Bodies> pairs_;
  SelfPairs self_pairs_;
  Task* tasks_[2] = {};
  uint32_t task_capacity_ = 0;
};

}  // namespace

template <class Bodies>
void traverse(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
              const CandidateOutput& make_output, int64_t* node_tests) {
  if (input.pair_count == 0) {
    fill_bytes(context, node_tests, 0, 1);
    make_output(0);
    return;
  }
  CandidateSink found;
  const TraverseCounters seen = Traversal<Bodies>(context, bodies, input, nullptr, true).run(found);
  const auto edge_edge = static_cast<int64_t>(seen.candidates.front),
             vertex_face = static_cast<int64_t>(seen.candidates.back);
  Candidate* out = make_output(edge_edge + vertex_face);
  copy(context, found.items, edge_edge, out);
  copy(context, found.items + found.capacity - vertex_face, vertex_face, out + edge_edge);
  const int64_t tests = static_cast<int64_t>(seen.node_tests);
  for_each_item(context, 1, [=] __device__(int64_t) { *node_tests = tests; });
}

template <class Bodies>
CandidateSpan traverse_padded(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                              const int64_t* pair_count, const TraverseCapacity& capacity, int64_t* counts,
                              const SearchFirstPart& search) {
  if (input.pair_count == 0) {
    for_each_item(context, kTraverseCounts, [=] __device__(int64_t k) {
      if (k != kTraverseBegan) counts[k] = k == kTraverseEnded ? nanoseconds() : 0;
    });
    return {};
  }
  return Traversal<Bodies>(context, bodies, input, pair_count, capacity.crowded).run_padded(capacity, counts, search);
}

template void traverse(const DeviceContext&, const RigidBodies&, const TraverseInput&, const CandidateOutput&,
                       int64_t*);
template void traverse(const DeviceContext&, const DeformingBodies&, const TraverseInput&, const CandidateOutput&,
                       int64_t*);
template CandidateSpan traverse_padded(const DeviceContext&, const RigidBodies&, const TraverseInput&, const int64_t*,
                                       const TraverseCapacity&, int64_t*, const SearchFirstPart&);
template CandidateSpan traverse_padded(const DeviceContext&, const DeformingBodies&, const TraverseInput&,
                                       const int64_t*, const TraverseCapacity&, int64_t*, const SearchFirstPart&);

}  // namespace pgccd
