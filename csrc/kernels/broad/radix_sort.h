// Radix sort of bodies by a key, on the CPU.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>
#include <vector>

namespace pgccd {

struct KeyedBody {
  uint64_t key;
  int32_t body;
};

// Least significant digit first; digits common to all keys are skipped. Small inputs are sorted by comparisons, with
// the same result, because clearing the buckets would take longer.
inline void radix_sort(std::vector<KeyedBody>& items) {
  constexpr size_t kFew = 128;
  if (items.size() <= kFew) {
    return std::stable_sort(items.begin(), items.end(),
                            [](const KeyedBody& a, const KeyedBody& b) { return a.key < b.key; });
  }
  constexpr int kDigitBits = 11;
  constexpr int kBuckets = 1 << kDigitBits;
  uint64_t all_or = 0, all_and = ~uint64_t{0};
  for (const KeyedBody& item : items) {
    all_or |= item.key;
    all_and &= item.key;
  }
  const uint64_t varying = all_or ^ all_and;
  std::vector<KeyedBody> other(items.size());
  for (int shift = 0; shift < 64; shift += kDigitBits) {
    if (((varying >> shift) & (kBuckets - 1)) == 0) continue;
    std::array<int64_t, kBuckets> start{};
    for (const KeyedBody& item : items) ++start[(item.key >> shift) & (kBuckets - 1)];
    std::exclusive_scan(start.begin(), start.end(), start.begin(), int64_t{0});
    for (const KeyedBody& item : items) other[start[(item.key >> shift) & (kBuckets - 1)]++] = item;
    items.swap(other);
  }
}

}  // namespace pgccd
