// The launches of the traversal. Everything is sized by guesses and counted on the device, so that nothing waits for
// the host on the way; the counts then tell whether it all fitted.
#include <cub/cub.cuh>

#include "kernels/traverse/descend.cuh"
#include "kernels/traverse/traverse_cuda.h"
#include "kernels/traverse/visit_leaves.cuh"

namespace pgccd {
namespace {

// Blocks come in so many waves: as long as one lasts, kernels of other streams, of whatever priority, find no place.
// Of four, the time of a search does not show.
constexpr int kWaves = 4;

// Launches that continue what warps hand back, before the host asks whether anything is left. Their number grows by
// two orders of magnitude with each, until the device is full.
constexpr int kLaunchesPerBatch = 4;

struct Counters {
  uint32_t rest[3], taken[3];  // tasks handed back, and taken: launches take turns, see TaskHandover
  uint32_t most_rest;
  uint32_t leaves;
  uint32_t edge_edge, vertex_face;  // candidates
  uint32_t poses;
  unsigned long long node_tests;
  unsigned long long within;  // see PairsWithin
};

// Of bodies that may be tested against themselves.
int64_t deforming_vertices(const RigidBodies&) { return 0; }
int64_t deforming_vertices(const DeformingBodies& bodies) { return bodies.vertex_count; }

PGCCD_HD int64_t candidates_of(const Counters& seen) { return int64_t{seen.edge_edge} + seen.vertex_face; }

uint32_t bounded(int64_t count) { return static_cast<uint32_t>(smaller<int64_t>(count, 0xfffffff0)); }

struct Capacity {
  uint32_t poses, tasks, leaves, candidates;

  static uint32_t grown(uint32_t needed, uint32_t capacity) {
    return needed <= capacity ? capacity : bounded(needed + int64_t{needed} / 4);
  }
  // What the standard scene needs, twice over; and bodies that are tested against themselves, up to a size: each vertex
  // of folded cloth stands for some ten pairs of leaves, and as many candidates.
  static Capacity guess(const TraverseInput& input, int64_t vertex_count) {
    const auto sum = [&](int64_t each_pair, int64_t each_vertex = 0) {
      return bounded(each_pair * input.pair_count + 65536 +
                     smaller<int64_t>(each_vertex * vertex_count, int64_t{1} << 22));
    };
    if (input.leading) return {sum(3), sum(1), sum(1), sum(4)};
    return {sum(3), sum(1, 4), sum(16, 16), sum(12, 24)};
  }
  PGCCD_HD bool holds(const Counters& seen) const {
    return seen.poses <= poses && seen.most_rest <= tasks && seen.leaves <= leaves && candidates_of(seen) <= candidates;
  }
  void grow(const Counters& seen) {
    poses = grown(seen.poses, poses);
    tasks = grown(seen.most_rest, tasks);
    leaves = grown(seen.leaves, leaves);
    candidates = grown(bounded(candidates_of(seen)), candidates);
  }
};

// All public: device lambdas may not be made in private members.
template <class Bodies>
struct Traversal {
  using Sweep = typename SweepOf<Bodies>::type;

  // `count`: of the pairs, on the device; null if that is all of the input's.
  Traversal(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input, const int64_t* count)
      : context_(context), bodies_(bodies), input_(input), counters_(context.allocate<Counters>(1)) {
    pairs_ = {bodies,
              context.allocate<Sweep>(input.pair_count),
              nullptr,
              context.allocate<uint32_t>(input.pair_count),
              count != nullptr ? count : count_on_device(),
              &counters_->poses,
              0};
    const int64_t most_within = Sweep::may_be_one_body ? input.pair_count : 0;
    within_ = {&counters_->within, context.allocate<uint32_t>(most_within), context.allocate<int32_t>(most_within)};
  }

  int64_t* count_on_device() {
    int64_t* on_device = context_.allocate<int64_t>(1);
    const int64_t count = input_.pair_count;
    for_each_item(context_, 1, [=] __device__(int64_t) { *on_device = count; });
    return on_device;
  }

  // Until everything fits: overflow is counted, never dropped.
  Counters run(CandidateSink& out) {
    Capacity capacity = Capacity::guess(input_, deforming_vertices(bodies_));
    for (;;) {
      const TaskList leaves = start(capacity, out);
      Counters seen = input_.leading ? lead(leaves, out) : descend_all(leaves, out);
      if (capacity.holds(seen)) return seen;
      capacity.grow(seen);
    }
  }

  // Without waiting.
  CandidateSpan run_within(const TraverseCapacity& given, int64_t* counts) {
    const Capacity capacity{bounded(larger<int64_t>(given.poses, kMaxSegments + 1)), bounded(given.tasks),
                            bounded(given.leaf_pairs), bounded(given.candidates)};
    CandidateSink out;
    const TaskList leaves = start(capacity, out);
    descend_roots(leaves);
    for (int launch = 1; launch <= given.launches; ++launch) {
      descend_rest(launch, launch == given.launches ? kLastLaunch : launch, leaves);
    }
    visit(leaves, 0, out);
    const Counters* seen = counters_;
    const int last = static_cast<int>(given.launches % 3);
    for_each_item(context_, 1, [=] __device__(int64_t) {
      counts[kPosesNeeded] = seen->poses;
      counts[kTasksNeeded] = larger(seen->most_rest, seen->rest[last]);
      counts[kLeafPairsNeeded] = seen->leaves;
      counts[kCandidatesNeeded] = candidates_of(*seen);
      counts[kTasksLeft] = seen->rest[last];
      counts[kNodeTests] = static_cast<int64_t>(seen->node_tests);
      counts[kTraverseOverflow] =
          counts[kTasksLeft] != 0 || counts[kTasksNeeded] > capacity.tasks || !capacity.holds(*seen);
      counts[kTraverseEnded] = nanoseconds();
    });
    return {out.items, capacity.candidates, out.edge_edge_count, out.vertex_face_count};
  }

  TaskList start(const Capacity& capacity, CandidateSink& out) {
    fill_bytes(context_, counters_, 0, 1);
    out = {context_.allocate<Candidate>(capacity.candidates), &counters_->edge_edge, &counters_->vertex_face,
           capacity.candidates};
    place_pairs(capacity.poses);
    task_capacity_ = capacity.tasks;
    for (Task*& tasks : tasks_) tasks = context_.allocate<Task>(capacity.tasks);
    return {context_.allocate<Task>(capacity.leaves), &counters_->leaves, capacity.leaves};
  }

  // Sweeps and poses of all body pairs; how many poses each needs depends on how far its bodies turn.
  void place_pairs(uint32_t capacity) {
    const Bodies bodies = bodies_;
    const TraverseInput input = input_;
    Counters* counters = counters_;
    const PairsWithin within = within_;
    auto* sweeps = const_cast<Sweep*>(pairs_.sweeps);
    auto* pose_begin = const_cast<uint32_t*>(pairs_.pose_begin);
    LocalPose* poses = context_.allocate<LocalPose>(capacity);
    pairs_.poses = poses;
    pairs_.pose_capacity = capacity;
    for_each_counted(context_, pairs_.given_count, input.pair_count, [=] __device__(int64_t pair) {
      const double horizon = input.horizon ? input.horizon[pair] : 1.0;
      const Sweep sweep(bodies, input.pairs[2 * pair], input.pairs[2 * pair + 1], input.settings, horizon);
      uint32_t begin = warp_append(&counters->poses, static_cast<uint32_t>(sweep.segment_count) + 1u);
      if (begin + sweep.segment_count >= capacity) begin = 0;  // somebody else's: nobody will look
      for (int k = 0; k <= sweep.segment_count; ++k) store_words(sweep.pose(bodies, k), poses[begin + k]);
      store_words(sweep, sweeps[pair]);
      within.add_if_one_body(bodies, sweep, static_cast<int32_t>(pair));
      pose_begin[pair] = begin;
    });
  }

  Counters lead(TaskList leaves, CandidateSink out) {
    const int64_t blocks = (input_.pair_count + kBlockThreads - 1) / kBlockThreads;
    descend_greedily<Bodies>
        <<<static_cast<unsigned>(blocks), kBlockThreads, 0, context_.stream>>>(pairs_, leaves, &counters_->node_tests);
    check_cuda(cudaGetLastError(), "descend_greedily");
    visit(leaves, 0, out);
    return read(context_, counters_);
  }

  Counters descend_all(TaskList leaves, CandidateSink out) {
    descend_roots(leaves);
    uint32_t visited = 0;
    for (int launch = 0;;) {
      for (int k = 0; k < kLaunchesPerBatch; ++k) {
        ++launch;
        descend_rest(launch, launch, leaves);
      }
      // Leaves are visited at once in the hope that none are to come.
      visit(leaves, visited, out);
      const Counters seen = read(context_, counters_);
      const uint32_t left = seen.rest[launch % 3];
      if (left == 0 || larger(seen.most_rest, left) > task_capacity_) return seen;
      visited = smaller(seen.leaves, leaves.capacity);
    }
  }

  // What the launch leaves.
  TaskList rest_of(int launch) { return {tasks_[launch % 2], &counters_->rest[launch % 3], task_capacity_}; }

  void descend_roots(TaskList leaves) {
    const TaskList rest = rest_of(0);
    descend_from_roots<Bodies>
        <<<kWaves * resident_blocks_of(descend_from_roots<Bodies>), kBlockThreads, 0, context_.stream>>>(
            pairs_, &counters_->taken[0], leaves, rest, &counters_->node_tests);
    check_cuda(cudaGetLastError(), "descend_from_roots");
    if constexpr (Sweep::may_be_one_body) {
      start_within<Bodies><<<resident_blocks_of(start_within<Bodies>), kBlockThreads, 0, context_.stream>>>(
          pairs_, within_, leaves, rest, &counters_->node_tests);
      check_cuda(cudaGetLastError(), "start_within");
    }
  }

  // `kind`: the launch, or kLastLaunch.
  void descend_rest(int launch, int kind, TaskList leaves) {
    const int next = (launch + 1) % 3;
    const TaskHandover rest{rest_of(launch - 1),    rest_of(launch),         &counters_->taken[launch % 3],
                            &counters_->rest[next], &counters_->taken[next], &counters_->most_rest};
    descend_further<Bodies><<<resident_blocks_of(descend_further<Bodies>), kBlockThreads, 0, context_.stream>>>(
        pairs_, kind, rest, leaves, &counters_->node_tests);
    check_cuda(cudaGetLastError(), "descend_further");
  }

  void visit(TaskList leaves, uint32_t begin, CandidateSink out) {
    visit_leaves<Bodies><<<kWaves * resident_blocks_of(visit_leaves<Bodies>), kBlockThreads, 0, context_.stream>>>(
        pairs_, leaves, begin, out);
    check_cuda(cudaGetLastError(), "visit_leaves");
  }

  const DeviceContext& context_;
  const Bodies& bodies_;
  const TraverseInput& input_;
  Counters* counters_;
  Pairs<Bodies> pairs_;
  PairsWithin within_;
  Task* tasks_[2] = {};
  uint32_t task_capacity_ = 0;
};

}  // namespace

template <class Bodies>
void traverse_cuda(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                   const CandidateOutput& make_output, int64_t* node_tests) {
  if (input.pair_count == 0) {
    fill_bytes(context, node_tests, 0, 1);
    make_output(0);
    return;
  }
  CandidateSink found;
  const Counters seen = Traversal<Bodies>(context, bodies, input, nullptr).run(found);
  Candidate* out = make_output(candidates_of(seen));
  copy(context, found.items, seen.edge_edge, out);
  copy(context, found.items + found.capacity - seen.vertex_face, seen.vertex_face, out + seen.edge_edge);
  const int64_t tests = static_cast<int64_t>(seen.node_tests);
  for_each_item(context, 1, [=] __device__(int64_t) { *node_tests = tests; });
}

template <class Bodies>
CandidateSpan traverse_within(const DeviceContext& context, const Bodies& bodies, const TraverseInput& input,
                              const int64_t* pair_count, const TraverseCapacity& capacity, int64_t* counts) {
  if (input.pair_count == 0) {
    for_each_item(context, kTraverseCounts, [=] __device__(int64_t k) {
      if (k != kTraverseBegan) counts[k] = k == kTraverseEnded ? nanoseconds() : 0;
    });
    return {};
  }
  return Traversal<Bodies>(context, bodies, input, pair_count).run_within(capacity, counts);
}

template void traverse_cuda(const DeviceContext&, const RigidBodies&, const TraverseInput&, const CandidateOutput&,
                            int64_t*);
template void traverse_cuda(const DeviceContext&, const DeformingBodies&, const TraverseInput&, const CandidateOutput&,
                            int64_t*);
template CandidateSpan traverse_within(const DeviceContext&, const RigidBodies&, const TraverseInput&, const int64_t*,
                                       const TraverseCapacity&, int64_t*);
template CandidateSpan traverse_within(const DeviceContext&, const DeformingBodies&, const TraverseInput&,
                                       const int64_t*, const TraverseCapacity&, int64_t*);

}  // namespace pgccd
