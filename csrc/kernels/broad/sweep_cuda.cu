#include <cub/cub.cuh>

#include "kernels/broad/pair_list.cuh"
#include "kernels/broad/sweep_item.h"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Doubles as unsigned integers of the same order, for atomic minima.
__device__ unsigned long long ordered_bits(double x) {
  const auto bits = static_cast<unsigned long long>(__double_as_longlong(x));
  return (bits >> 63) ? ~bits : (bits | 0x8000000000000000ull);
}
__device__ double from_ordered_bits(unsigned long long key) {
  const unsigned long long bits = (key >> 63) ? (key & 0x7fffffffffffffffull) : ~key;
  return __longlong_as_double(static_cast<long long>(bits));
}

struct Frame {
  unsigned long long lower[3];  // ordered bits of the scene's lower corner
  int axis;
};

// From a sample: the axis affects the time of the sweep, not its result.
__global__ void choose_axis(BroadBodies bodies, int given, Frame* frame) {
  wait_for_previous_kernels();
  constexpr int kSample = 8192;
  __shared__ double sums[3], squares[3];
  if (threadIdx.x < 3) sums[threadIdx.x] = squares[threadIdx.x] = 0.0;
  __syncthreads();
  const int64_t stride = bodies.count > kSample ? bodies.count / kSample : 1;
  const double* reference = bodies.centres.position_t0;  // relative to the first body, to preserve precision
  double sum[3] = {}, square[3] = {};
  for (int64_t b = threadIdx.x * stride; b < bodies.count; b += blockDim.x * stride) {
    if (bodies.is_absent(b)) continue;
    for (int k = 0; k < 3; ++k) {
      const double x = bodies.centres.position_t0[3 * b + k] - reference[k];
      sum[k] += x;
      square[k] += x * x;
    }
  }
  for (int k = 0; k < 3; ++k) {
    atomicAdd(&sums[k], sum[k]);
    atomicAdd(&squares[k], square[k]);
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  const double samples = static_cast<double>((bodies.count + stride - 1) / stride);
  int axis = 0;
  double best = -1.0;
  for (int k = 0; k < 3; ++k) {
    const double variance = squares[k] - sums[k] * sums[k] / samples;
    if (variance > best) {
      best = variance;
      axis = k;
    }
  }
  frame->axis = given >= 0 ? given : axis;
}

__global__ void __launch_bounds__(kBlockThreads) lower_corner(BroadBodies bodies, Frame* frame) {
  wait_for_previous_kernels();
  __shared__ unsigned long long block_lower[3];
  if (threadIdx.x < 3) block_lower[threadIdx.x] = ~0ull;
  __syncthreads();
  double least[3] = {INFINITY, INFINITY, INFINITY};
  for (int64_t b = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; b < bodies.count;
       b += static_cast<int64_t>(gridDim.x) * blockDim.x) {
    if (bodies.is_absent(b)) continue;
    const Vec3<double> corner = swept_box(bodies, b).lower;
    for (int k = 0; k < 3; ++k) least[k] = smaller(component(corner, k), least[k]);
  }
  for (int k = 0; k < 3; ++k) atomicMin(&block_lower[k], ordered_bits(least[k]));
  __syncthreads();
  if (threadIdx.x < 3) atomicMin(&frame->lower[threadIdx.x], block_lower[threadIdx.x]);
}

struct SortedInterval {
  float lower_1, upper_1, lower_2, upper_2;  // on the two axes not swept
};

// One warp per piece of a body's interval; pieces are short, so that several warps share an interval as long as the
// scene.
constexpr int64_t kPieceTests = 2048;

struct SweepArrays {
  const uint64_t* key;  // sorted lower ends
  const int32_t* body;  // in that order
  const SortedInterval* box;
  const int32_t* end;          // first index past the upper end
  const int64_t* first_piece;  // exclusive prefix sum of pieces per body, then the total
};

__global__ void __launch_bounds__(kBlockThreads) sweep_pieces(int64_t body_count, SweepArrays arrays, PairList out) {
  wait_for_previous_kernels();
  if (!out.is_wanted()) return;
  const int lane = threadIdx.x & 31;
  const int64_t warps = static_cast<int64_t>(gridDim.x) * blockDim.x / 32;
  const int64_t pieces = arrays.first_piece[body_count];
  for (int64_t piece = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / 32; piece < pieces;
       piece += warps) {
    int64_t low = 0, high = body_count;  // binary search of the piece's body: the last with first_piece <= piece
    while (high - low > 1) {
      const int64_t middle = (low + high) / 2;
      (arrays.first_piece[middle] <= piece ? low : high) = middle;
    }
    const int64_t p = low;
    const int64_t begin = p + 1 + (piece - arrays.first_piece[p]) * kPieceTests;
    const int64_t end = smaller(begin + kPieceTests, static_cast<int64_t>(arrays.end[p]));
    const SortedInterval mine = arrays.box[p];
    const int32_t self = arrays.body[p];
    for (int64_t q = begin + lane; q < end; q += 32) {
      const SortedInterval other = arrays.box[q];
      if (!(other.lower_1 <= mine.upper_1 && other.upper_1 >= mine.lower_1 && other.lower_2 <= mine.upper_2 &&
            other.upper_2 >= mine.lower_2)) {
        continue;
      }
      out.append(pack_pair(self, arrays.body[q]));
    }
  }
}

}  // namespace

void find_pairs_by_sweep(const DeviceContext& context, const BroadBodies& bodies, int axis, const PairSink& out) {
  const int64_t count = bodies.count;
  Frame* frame = context.allocate<Frame>(1);
  fill_bytes(context, frame, 0xff, 1);
  launch_kernel(context, choose_axis, 1, 256, bodies, axis, frame);
  launch_kernel(context, lower_corner, resident_blocks(context, 4), kBlockThreads, bodies, frame);

  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted_keys = context.allocate<uint64_t>(count);
  int32_t* order = context.allocate<int32_t>(count);
  int32_t* sorted_order = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t b) {
    const int swept = frame->axis;
    const double origin = from_ordered_bits(frame->lower[swept]);
    keys[b] = sweep_key(bodies, b, float_below(component(swept_box(bodies, b).lower, swept) - origin));
    order[b] = static_cast<int32_t>(b);
  });
  const int key_bits = bodies.world ? 64 : 32;
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, order, sorted_order, count, 0, key_bits,
                                           context.stream);
  });

  SortedInterval* boxes = context.allocate<SortedInterval>(count);
  int32_t* ends = context.allocate<int32_t>(count);
  int64_t* piece_counts = context.allocate<int64_t>(count + 1);
  int64_t* first_piece = context.allocate<int64_t>(count + 1);
  for_each_item(context, count + 1, [=] __device__(int64_t p) {
    if (p == count) {
      piece_counts[p] = 0;
      return;
    }
    const int swept = frame->axis, second = (swept + 1) % 3, third = (swept + 2) % 3;
    const int64_t b = sorted_order[p];
    const SweptBox box = swept_box(bodies, b);
    const double origin[3] = {from_ordered_bits(frame->lower[0]), from_ordered_bits(frame->lower[1]),
                              from_ordered_bits(frame->lower[2])};
    const uint64_t upper = sweep_key(bodies, b, float_above(component(box.upper, swept) - origin[swept]));
    int64_t low = p, high = bodies.is_absent(b) ? p + 1 : count;  // first index whose key is past `upper`
    while (low < high) {
      const int64_t middle = (low + high) / 2;
      if (sorted_keys[middle] <= upper) {
        low = middle + 1;
      } else {
        high = middle;
      }
    }
    ends[p] = static_cast<int32_t>(low);
    piece_counts[p] = (low - p - 1 + kPieceTests - 1) / kPieceTests;
    boxes[p] = {float_below(component(box.lower, second) - origin[second]),
                float_above(component(box.upper, second) - origin[second]),
                float_below(component(box.lower, third) - origin[third]),
                float_above(component(box.upper, third) - origin[third])};
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(scratch, bytes, piece_counts, first_piece, count + 1, context.stream);
  });

  const SweepArrays arrays{sorted_keys, sorted_order, boxes, ends, first_piece};
  collect_pairs(context, bodies, out, [&](const PairList& list) {
    launch_kernel(context, sweep_pieces, resident_blocks(context, 16), kBlockThreads, count, arrays, list);
  });
}

}  // namespace pgccd
