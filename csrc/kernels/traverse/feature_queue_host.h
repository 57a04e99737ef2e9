// Feature pairs of a pair of leaves, which the host tests eight at a time.
#pragma once

#include "core/feature_lanes.h"
#include "kernels/traverse/leaf_item.h"
#include "kernels/traverse/time_windows.h"

namespace pgccd {

// Feature pairs that wait for one test, each with a number that the caller knows it by.
class FeatureQueue {
 public:
  bool is_full() const { return count_ == kLanes; }
  bool is_empty() const { return count_ == 0; }
  void add(const MovingFeatures<float>& features, int number) {
    start_.set(count_, features.start);
    end_.set(count_, features.end);
    is_edge_edge_[count_] = features.is_edge_edge ? -1 : 0;
    number_[count_++] = number;
  }
  void add(const FeatureQueue& from, int lane) {
    start_.copy(count_, from.start_, lane);
    end_.copy(count_, from.end_, lane);
    is_edge_edge_[count_] = from.is_edge_edge_[lane];
    number_[count_++] = from.number_[lane];
  }
  // Calls use(lane, number) for those for which the test, apart(features, unused lanes), is false. Empties the queue.
  template <class Test, class Use>
  void flush(const Test& apart, const Use& use) {
    const uint32_t used = (1u << count_) - 1u;
    count_ = 0;
    const MovingFeatures<Float8> features{start_.pairs(), end_.pairs(), load_mask(is_edge_edge_)};
    for_each_bit(used & ~lane_bits(apart(features, lanes_without(used))), [&](int lane) { use(lane, number_[lane]); });
  }

 private:
  static Mask8 load_mask(const int32_t* first) {
    Mask8 out;
    __builtin_memcpy(&out, first, sizeof(out));
    return out;
  }

  FeatureLanes start_, end_;
  alignas(32) int32_t is_edge_edge_[kLanes] = {};
  int number_[kLanes];
  int count_ = 0;
};

// Both tests of feature pairs. Calls meets(number) for those that may meet.
template <class Meets>
class FeatureTests {
 public:
  explicit FeatureTests(const Meets& meets) : meets_(meets) {}

  void add(const MovingFeatures<float>& features, int number, float distance) {
    waiting_.add(features, number);
    if (waiting_.is_full()) test_plainly(distance);
  }
  void finish(float distance) {
    if (!waiting_.is_empty()) test_plainly(distance);
    if (!near_.is_empty()) test_stepwise(distance);
  }

 private:
  void test_plainly(float distance) {
    waiting_.flush([&](const auto& features, Mask8 out) { return features.plainly_apart(distance, out); },
                   [&](int lane, int) {
                     near_.add(waiting_, lane);
                     if (near_.is_full()) test_stepwise(distance);
                   });
  }
  void test_stepwise(float distance) {
    near_.flush([&](const auto& features, Mask8 out) { return features.stepwise_apart(distance, out); },
                [&](int, int number) { meets_(number); });
  }

  const Meets& meets_;
  FeatureQueue waiting_, near_;
};

}  // namespace pgccd
