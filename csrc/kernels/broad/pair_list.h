// Test, collection and sort of pairs in the broad phases on the CPU.
#pragma once

#include <vector>

#include "kernels/broad/broad.h"
#include "kernels/broad/filter_box.h"
#include "kernels/executor.h"

namespace pgccd {

// Packed pairs, unsorted.
using FoundPairs = std::vector<uint64_t>;

// `scan` may read this many entries past the end of its input, and ignores them: arrays are padded accordingly.
constexpr int64_t kScanPadding = 4;

// One worker's collector of candidates among sorted boxes. Candidates are tested in batches, so that the predicate's
// scattered reads overlap.
class PairCollector {
 public:
  PairCollector(const BroadBodies& bodies, const FilterBox* boxes) : bodies_(bodies), boxes_(boxes) {}

  void add(int64_t a, int64_t b) {
    if (size_ == kBatch) test_batch();
    batch_[size_++] = {static_cast<int32_t>(a), static_cast<int32_t>(b)};
  }

  // Adds those of the boxes [begin, end) that overlap box `self` and for which `keep(position)` is true.
  template <class Keep>
  void scan(int64_t self, const BoxOverlap& overlap, int64_t begin, int64_t end, Keep&& keep) {
    // In packs and without branches on the outcome: the number of boxes and the overlaps are hard to predict.
    do {
      if (size_ > kBatch - kScanPadding) test_batch();
      for (int64_t other = begin; other < begin + kScanPadding; ++other) {
        batch_[size_] = {static_cast<int32_t>(self), static_cast<int32_t>(other)};
        size_ += static_cast<int64_t>(overlap.with(boxes_[other]) & (other < end) & keep(other));
      }
      begin += kScanPadding;
    } while (begin < end);
  }

  FoundPairs take() {
    test_batch();
    return std::move(found_);
  }

 private:
  struct Positions {
    int32_t a, b;
  };

  void test_batch();

  static constexpr int64_t kBatch = 256;
  const BroadBodies& bodies_;
  const FilterBox* boxes_;
  Positions batch_[kBatch + 1] = {};
  int64_t size_ = 0;
  FoundPairs found_;
};

inline std::vector<FoundPairs> take_all(std::vector<PairCollector>& collectors) {
  std::vector<FoundPairs> found;
  for (PairCollector& collector : collectors) found.push_back(collector.take());
  return found;
}

// Sorts and writes the pairs of all workers.
void write_sorted(const Executor& executor, const std::vector<FoundPairs>& found, int64_t body_count,
                  const PairOutput& make_output);

}  // namespace pgccd
