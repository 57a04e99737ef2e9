#include <algorithm>
#include <array>
#include <cmath>
#include <experimental/simd>
#include <numeric>

#include "kernels/broad/broad.h"
#include "kernels/broad/pair_list.h"
#include "kernels/broad/radix_sort.h"
#include "kernels/broad/sweep_item.h"

namespace pgccd {
namespace {

namespace simd = std::experimental;
using FloatPack = simd::native_simd<float>;

// From a sample: the axis affects the time of the sweep, not its result.
int axis_of_largest_variance(const BroadBodies& bodies) {
  constexpr int64_t kSample = 8192;
  const int64_t stride = std::max<int64_t>(1, bodies.count / kSample);
  double best = -1.0;
  int best_axis = 0;
  for (int axis = 0; axis < 3; ++axis) {
    double mean = 0.0, squares = 0.0;
    int64_t seen = 0;
    for (int64_t b = 0; b < bodies.count; b += stride) {
      if (bodies.is_absent(b)) continue;
      const double x = 0.5 * bodies.centres.position_t0[3 * b + axis] + 0.5 * bodies.centres.position_t1[3 * b + axis];
      const double delta = x - mean;
      mean += delta / static_cast<double>(++seen);
      squares += delta * (x - mean);
    }
    if (squares > best) {
      best = squares;
      best_axis = axis;
    }
  }
  return best_axis;
}

// Bodies in the order of their lower ends, one array per bound, padded so that whole packs can be read.
struct SortedIntervals {
  std::vector<int32_t> body;
  std::vector<int64_t> end;      // first index whose lower end is past this body's upper end
  std::vector<float> bounds[4];  // lower and upper on the second axis, lower and upper on the third
};

SortedIntervals sort_intervals(const Executor& executor, const BroadBodies& bodies, int axis) {
  const int64_t count = bodies.count;
  Vec3<double> origin{HUGE_VAL, HUGE_VAL, HUGE_VAL};
  for (int64_t b = 0; b < count; ++b) {
    if (bodies.is_absent(b)) continue;
    const Vec3<double> lower = swept_box(bodies, b).lower;
    origin = {smaller(origin.x, lower.x), smaller(origin.y, lower.y), smaller(origin.z, lower.z)};
  }
  const int second = (axis + 1) % 3, third = (axis + 2) % 3;
  std::vector<KeyedBody> keyed(count);
  std::vector<uint64_t> upper_key(count);
  constexpr int64_t kGrain = 4096;
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      const SweptBox box = swept_box(bodies, b);
      keyed[b] = {sweep_key(bodies, b, float_below(component(box.lower, axis) - component(origin, axis))),
                  static_cast<int32_t>(b)};
      upper_key[b] = sweep_key(bodies, b, float_above(component(box.upper, axis) - component(origin, axis)));
    }
  });
  radix_sort(keyed);

  SortedIntervals sorted;
  sorted.body.resize(count);
  sorted.end.resize(count);
  const int64_t padded = count + static_cast<int64_t>(FloatPack::size());
  for (auto& bound : sorted.bounds) bound.assign(padded, 0.0f);
  parallel_chunks(executor, count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      const int32_t b = keyed[p].body;
      const SweptBox box = swept_box(bodies, b);
      sorted.body[p] = b;
      const auto limit = bodies.is_absent(b) ? keyed.begin() + p + 1 : keyed.end();
      const auto past = std::upper_bound(keyed.begin() + p, limit, upper_key[b],
                                         [](uint64_t key, const KeyedBody& item) { return key < item.key; });
      sorted.end[p] = past - keyed.begin();
      sorted.bounds[0][p] = float_below(component(box.lower, second) - component(origin, second));
      sorted.bounds[1][p] = float_above(component(box.upper, second) - component(origin, second));
      sorted.bounds[2][p] = float_below(component(box.lower, third) - component(origin, third));
      sorted.bounds[3][p] = float_above(component(box.upper, third) - component(origin, third));
    }
  });
  return sorted;
}

// Tests index p against [begin, end): boxes on the other two axes in packs, then the predicate.
void scan(const BroadBodies& bodies, const SortedIntervals& sorted, int64_t p, int64_t begin, int64_t end,
          FoundPairs& out) {
  constexpr int64_t kWidth = static_cast<int64_t>(FloatPack::size());
  const float lower_1 = sorted.bounds[0][p], upper_1 = sorted.bounds[1][p];
  const float lower_2 = sorted.bounds[2][p], upper_2 = sorted.bounds[3][p];
  const int32_t self = sorted.body[p];
  const auto load = [&](int bound, int64_t at) { return FloatPack(&sorted.bounds[bound][at], simd::element_aligned); };
  for (int64_t q = begin; q < end; q += kWidth) {
    const auto overlap =
        (load(0, q) <= upper_1) && (load(1, q) >= lower_1) && (load(2, q) <= upper_2) && (load(3, q) >= lower_2);
    if (simd::none_of(overlap)) continue;
    for (int64_t lane = 0; lane < std::min(kWidth, end - q); ++lane) {
      if (!overlap[lane]) continue;
      const uint64_t pair = pack_pair(self, sorted.body[q + lane]);
      if (is_potentially_colliding(bodies, first_of(pair), second_of(pair))) out.push_back(pair);
    }
  }
}

}  // namespace

void find_pairs_by_sweep(const Executor& executor, const BroadBodies& bodies, int axis, const PairOutput& make_output) {
  if (bodies.count < 2) {
    make_output(0);
    return;
  }
  const SortedIntervals sorted = sort_intervals(executor, bodies, axis < 0 ? axis_of_largest_variance(bodies) : axis);

  // Workers take equal numbers of tests, not of bodies, so that several share an interval as long as the scene.
  std::vector<int64_t> first_test(bodies.count + 1, 0);
  for (int64_t p = 0; p < bodies.count; ++p) first_test[p + 1] = first_test[p] + (sorted.end[p] - p - 1);
  constexpr int64_t kTestGrain = 1 << 15;
  const int64_t chunks = (first_test.back() + kTestGrain - 1) / kTestGrain;
  std::vector<FoundPairs> found(std::clamp<int64_t>(chunks, 1, executor.worker_count()));
  parallel_chunks(executor, first_test.back(), kTestGrain, [&](int worker, int64_t begin, int64_t end) {
    int64_t p = std::upper_bound(first_test.begin(), first_test.end(), begin) - first_test.begin() - 1;
    for (int64_t test = begin; test < end; ++p) {
      const int64_t stop = std::min(end, first_test[p + 1]);
      if (stop > test)
        scan(bodies, sorted, p, p + 1 + (test - first_test[p]), p + 1 + (stop - first_test[p]), found[worker]);
      test = std::max(test, stop);
    }
  });
  write_sorted(executor, found, bodies.count, make_output);
}

}  // namespace pgccd
