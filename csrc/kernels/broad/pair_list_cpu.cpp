#include <atomic>
#include <memory>
#include <numeric>

#include "kernels/broad/pair_list.h"

namespace pgccd {

void PairCollector::test_batch() {
  int64_t kept = 0;
  for (int64_t k = 0; k < size_; ++k) {
    const Positions candidate = batch_[k];
    batch_[kept] = candidate;
    kept += static_cast<int64_t>(balls_meet(boxes_[candidate.a], boxes_[candidate.b]));
    for (const int32_t position : {candidate.a, candidate.b}) {
      const int64_t body = boxes_[position].body;
      __builtin_prefetch(bodies_.centres.position_t0 + 3 * body);
      __builtin_prefetch(bodies_.centres.position_t1 + 3 * body);
      __builtin_prefetch(bodies_.centres.radius + body);
    }
  }
  size_t count = found_.size();
  found_.resize(count + kept + 1);
  for (int64_t k = 0; k < kept; ++k) {
    const uint64_t pair = pack_pair(boxes_[batch_[k].a].body, boxes_[batch_[k].b].body);
    found_[count] = pair;
    count += static_cast<size_t>(is_potentially_colliding(bodies_, first_of(pair), second_of(pair)));
  }
  found_.resize(count);
  size_ = 0;
}

namespace {

// Rows of pairs with the same i are mostly short.
void sort_row(int32_t* first, int32_t* last) {
  constexpr int64_t kShort = 16;
  if (last - first > kShort) return std::sort(first, last);
  for (int32_t* at = first; at < last; ++at) {
    const int32_t value = *at;
    int32_t* place = at;
    for (; place > first && place[-1] > value; --place) *place = place[-1];
    *place = value;
  }
}

}  // namespace

// Counting sort by i, then a sort of each row.
void write_sorted(const Executor& executor, const std::vector<FoundPairs>& found, int64_t body_count,
                  const PairOutput& make_output) {
  int64_t total = 0;
  for (const FoundPairs& part : found) total += static_cast<int64_t>(part.size());
  int64_t* out = make_output(total);
  if (total == 0) return;

  const bool alone = found.size() == 1;
  const int64_t parts = static_cast<int64_t>(found.size());
  std::vector<int64_t> end(body_count + 1, 0);  // first counts, then the next free index of each row
  parallel_chunks(executor, parts, 1, [&](int, int64_t part, int64_t) {
    for (const uint64_t pair : found[part]) add_shared(end[first_of(pair) + 1], int64_t{1}, alone);
  });
  std::inclusive_scan(end.begin(), end.end(), end.begin());
  const auto second = std::make_unique_for_overwrite<int32_t[]>(total);
  parallel_chunks(executor, parts, 1, [&](int, int64_t part, int64_t) {
    for (const uint64_t pair : found[part])
      second[add_shared(end[first_of(pair)], int64_t{1}, alone)] = second_of(pair);
  });
  constexpr int64_t kGrain = 4096;
  parallel_chunks(executor, body_count, kGrain, [&](int, int64_t first, int64_t last) {
    int64_t row = first == 0 ? 0 : end[first - 1];
    for (int64_t i = first; i < last; ++i) {
      sort_row(&second[row], &second[end[i]]);
      for (; row < end[i]; ++row) {
        out[2 * row] = i;
        out[2 * row + 1] = second[row];
      }
    }
  });
}

}  // namespace pgccd
