// From pairs of roots to pairs of leaves. Eight threads process a task, one for each child of a split, depth first with
// a small stack of their own; after some rounds they return the remaining node pairs as new tasks. So body pairs whose
// costs differ by a factor of a thousand still load the device evenly, and most stay within their group.
#pragma once

#include "kernels/launch.cuh"
#include "kernels/traverse/start_self_pairs.cuh"
#include "kernels/traverse/support_item.h"
#include "kernels/traverse/words.cuh"
#include "kernels/traverse/work_share.cuh"

namespace pgccd {

// Resident blocks per multiprocessor: more would have too few registers for the poses of a round.
constexpr int kDescentBlocks = 4;
constexpr int kGroupsPerWarp = kWarp / kBlockWidth;
constexpr int kGroupsPerBlock = kBlockThreads / kBlockWidth;
constexpr int kStackSize = 64;
// Rounds before a group returns its stack: few while there are not enough tasks to keep the device busy to the end,
// more in later launches, when the work is already distributed. Very few tasks are distributed at once, since most of
// the device waits for them.
constexpr uint32_t kManyTasks = 1 << 18, kFewTasks = 2048;
// The last launch, if known to be the last, returns only node pairs beyond its stacks' capacity.
constexpr int kLastLaunch = 1 << 20;
PGCCD_HD int rounds_of_launch(int launch, uint32_t task_count) {
  if (launch == kLastLaunch) return kLastLaunch;
  constexpr int kRounds[] = {6, 6, 12, 48}, kRoundsOfFew[] = {2, 3, 4, 8};
  const int at = launch < 3 ? launch : 3, rounds = task_count < kFewTasks ? kRoundsOfFew[at] : kRounds[at];
  return task_count >= kManyTasks && rounds < 20 ? 20 : rounds;
}

// With few tasks, 8^n groups start from the same one. In each of the first n rounds a group continues with one child of
// its split, so that they share the work below without another launch.
constexpr uint32_t kGroupsOfFew = 8192;
constexpr int kMostSharedRounds = 2;
// Otherwise several groups would return the same node pairs. `rounds_of_launch` is never less than two either.
static_assert(kSelfPairRounds >= kMostSharedRounds);
__device__ inline int shared_rounds_of(uint32_t task_count) {
  constexpr uint32_t kWidth = kBlockWidth;
  return task_count <= kGroupsOfFew / (kWidth * kWidth) ? kMostSharedRounds
         : task_count <= kGroupsOfFew / kWidth          ? 1
                                                        : 0;
}

// The slots of the children with which a group continues in the next shared rounds: a digit of base 8 each, after a
// leading one.
class Route {
 public:
  Route() = default;
  __device__ Route(uint32_t group, int rounds) {
    const uint32_t groups = 1u << (kSlotBits * rounds);
    digits_ = groups + group % groups;
  }
  __device__ bool includes(uint32_t slot) const { return digits_ == 1 || digits_ % kBlockWidth == slot; }
  __device__ void next() { digits_ = larger(digits_ >> kSlotBits, 1u); }
  // True for one of the groups with the same remaining rounds behind them: this one reports what all of them find.
  __device__ bool is_first() const { return (digits_ & (digits_ - 1)) == 0; }

  static constexpr int kSlotBits = 3;
  static_assert(kBlockWidth == 1 << kSlotBits);

 private:
  uint32_t digits_ = 1;
};

// A group's memory: its stack and frequently read data.
template <class Sweep>
struct GroupShared {
  Sweep sweep;
  LocalPose poses[kPosesAtHand];
  SplitPair stack[kStackSize];
};

// The state of a group of eight threads.
struct Group {
  const LocalPose* poses = nullptr;
  int size = 0;
  int rounds_left = 0;
  int32_t pair = 0;
  Route route;
};

// In each round every group of a warp splits one node pair of its task. All data of a round are loaded at once: how a
// node pair will be split is decided when it is found. The first launch starts from the roots, later ones from the
// tasks that the one before returned.
template <bool kDividesTime, class Bodies>
__global__ void __launch_bounds__(kBlockThreads, kDescentBlocks)
    descend(Pairs<Bodies> pairs, int launch, TaskHandover handover, LeafPairList leaves, Counter* node_tests) {
  wait_for_previous_kernels();
  handover.prepare_next();
  const TaskList tasks = handover.from, rest = handover.to;
  const uint32_t task_count = pairs.count() > 0 ? tasks.size() : 0;
  const int shared_rounds = shared_rounds_of(task_count);
  const uint32_t count = task_count << (Route::kSlotBits * shared_rounds);
  // In the first launch a block takes at most 1.25 times its even share.
  const WorkQueue queue{handover.taken, count, launch == 0 ? count / gridDim.x + count / (4 * gridDim.x) + 1 : kNoItem};
  using Sweep = SweepOf<Bodies>;
  __shared__ alignas(16) char memory[kGroupsPerBlock * sizeof(GroupShared<Sweep>)];
  __shared__ WarpBuffer<LeafPair> buffers[kWarpsPerBlock];
  __shared__ uint32_t taken_by_block;
  const int lane = threadIdx.x % kWarp, slot = lane % kBlockWidth, shift = lane - slot;
  const int most_rounds = rounds_of_launch(launch, task_count);
  WorkShare share(queue, kGroupsPerWarp, taken_by_block);
  auto& shared = reinterpret_cast<GroupShared<Sweep>*>(memory)[threadIdx.x / kBlockWidth];
  Group group;
  WarpBuffer<LeafPair>& buffer = buffers[threadIdx.x / kWarp];
  const auto put_leaf = [&](Counter at, const LeafPair& leaf) { leaves.put(at, leaf); };
  int waiting = 0;
  uint32_t splits = 0;
  for (;;) {
    while (!share.is_over()) {
      const uint32_t idle = __ballot_sync(kAllLanes, slot == 0 && group.size == 0);
      if (idle == 0) break;
      const uint32_t item = share.take(idle, shift);
      if (group.size > 0 || item == kNoItem) continue;
      const Task task = tasks.items[item >> (Route::kSlotBits * shared_rounds)];
      copy_words(pairs.sweeps[task.pair], shared.sweep, slot, kBlockWidth);
      const LocalPose* poses = pairs.first_poses(task.pair);
      for (int k = 0; k < kPosesAtHand; ++k) copy_words(poses[k], shared.poses[k], slot, kBlockWidth);
      const bool is_one_body = Sweep::may_be_one_body && pairs.sweeps[task.pair].is_one_body();
      if (slot == 0) shared.stack[0] = task.split;
      group.poses = shared.poses;
      if (pairs.sweeps[task.pair].segment_count >= kPosesAtHand) group.poses = pairs.all_poses(task.pair);
      group.size = 1;
      group.rounds_left = is_one_body && launch != kLastLaunch ? kSelfPairRounds : most_rounds;
      group.pair = task.pair;
      group.route = Route(item, shared_rounds);
    }
    if (__ballot_sync(kAllLanes, group.size > 0) == 0) break;
    __syncwarp();  // after writes to shared memory
    bool meets = false, is_leaf = false;
    LeafPair child{group.pair, {0, 0}};
    SplitPair next = SplitPair::none();
    if (group.size > 0) {
      const PairTree<Bodies> tree(pairs.bodies, shared.sweep, group.poses);
      const SplitPair split = shared.stack[group.size - 1];
      child.leaves = split.child(slot);
      const NodeLink first = tree.link(0, child.leaves.first), second = tree.link(1, child.leaves.second);
      meets = child_may_meet<kDividesTime>(tree, split, slot);
      if (slot == 0 && group.route.is_first()) ++splits;
      meets = meets && group.route.includes(slot);
      group.route.next();
      is_leaf = meets && first.triangle_count != 0 && second.triangle_count != 0;
      if (meets && !is_leaf) next = tree.split(child.leaves, first, second);
      --group.size;
      --group.rounds_left;
    }
    const uint32_t leaf_lanes = __ballot_sync(kAllLanes, is_leaf && group.route.is_first());
    const uint32_t inner_lanes = (__ballot_sync(kAllLanes, meets && !is_leaf) >> shift) & 0xffu;
    __syncwarp();  // after every group has read the top of its stack
    if (meets && !is_leaf) shared.stack[group.size + __popc(inner_lanes & lanes_below(slot))] = next;
    group.size += __popc(inner_lanes);
    waiting = buffer.add(waiting, leaf_lanes, child, lane, leaves.count, put_leaf);

    __syncwarp();  // after writes to the stacks
    const bool hands_back = group.size > 0 && (group.rounds_left <= 0 || group.size > kStackSize - kBlockWidth);
    if (__ballot_sync(kAllLanes, hands_back) == 0) continue;
    if (hands_back) {
      const unsigned members = 0xffu << shift;
      Counter first = 0;
      if (slot == 0) first = atomicAdd(rest.count, static_cast<Counter>(group.size));
      first = __shfl_sync(members, first, shift);
      __syncwarp(members);
      for (int k = slot; k < group.size; k += kBlockWidth) rest.put(first + k, {group.pair, shared.stack[k]});
      __syncwarp(members);
      group.size = 0;
    }
  }
  buffer.flush(waiting, lane, leaves.count, put_leaf);
  for (int step = kWarp / 2; step > 0; step /= 2) splits += __shfl_down_sync(kAllLanes, splits, step);
  if (lane == 0 && splits > 0) atomicAdd(node_tests, static_cast<Counter>(splits) * kBlockWidth);
}

}  // namespace pgccd
