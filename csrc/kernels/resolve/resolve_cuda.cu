#include "kernels/launch.cuh"
#include "kernels/resolve/resolve.h"

namespace pgccd {
namespace {

struct FoundPairs {
  uint32_t count;
  uint32_t blocks_done;
};

// About one in ten pairs has a body that has changed, with a hundred bytes to read and write each: a block first
// collects these from a tile of pairs, so that all its threads have work. With few pairs, tiles are smaller, so that
// there is one for each block that the device holds.
constexpr int kLargestTile = 8 * kBlockThreads;

__global__ void __launch_bounds__(kBlockThreads)
    shortened_pairs_kernel(ShortenedPairs given, int tile_size, FoundPairs* found) {
  wait_for_previous_kernels();
  __shared__ int32_t tile[kLargestTile];
  __shared__ uint32_t count, first;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * tile_size;
  for (int64_t begin = static_cast<int64_t>(blockIdx.x) * tile_size; begin < given.pair_count; begin += stride) {
    if (threadIdx.x == 0) count = 0;
    __syncthreads();
    const int pairs = static_cast<int>(smaller<int64_t>(tile_size, given.pair_count - begin));
    for (int k = threadIdx.x; k < pairs; k += kBlockThreads) {
      require_on_device(given.changed.is_sound(begin + k), "pairs: expected padding, or bodies");
      if (given.changed(begin + k)) tile[warp_append(&count)] = k;
    }
    __syncthreads();
    if (threadIdx.x == 0) first = atomicAdd(&found->count, count);
    __syncthreads();
    for (uint32_t side = threadIdx.x; side < 2 * count; side += kBlockThreads) {
      given.store(begin + tile[side / 2], static_cast<int>(side % 2), int64_t{first} + side / 2);
    }
    __syncthreads();
  }
  if (threadIdx.x == 0 && is_last_block(&found->blocks_done)) {
    given.store_counts(atomicAdd(&found->count, 0u));
  }
}

}  // namespace

void slow_all_down(const DeviceContext& context, const SlowAllDown& bodies, int64_t* changes) {
  for_each_item(context, bodies.count, [=] __device__(int64_t row) {
    if (bodies.slow_down(row)) *changes = 1;  // all threads write the same value
  });
}

void lower_first_toi_of_bodies(const DeviceContext& context, const FirstToiInput& contacts, double* first) {
  // Non-negative doubles have the same order as their bits.
  static_assert(sizeof(long long) == sizeof(double));
  for_each_item(context, 2 * contacts.count, [=] __device__(int64_t side) {
    const int64_t body = contacts.pairs[side];
    require_on_device(contacts.is_sound(side), "pairs: expected padding, or bodies");
    if (body < 0) return;
    atomicMin(reinterpret_cast<long long*>(first + body), __double_as_longlong(contacts.toi[side / 2]));
  });
}

void shortened_pairs(const DeviceContext& context, const ShortenedPairs& given) {
  FoundPairs* const found = context.allocate<FoundPairs>(1);
  fill_bytes(context, found, 0, 1);
  const int64_t resident = resident_blocks_of(context, shortened_pairs_kernel);
  int tile_size = kBlockThreads;
  while (tile_size < kLargestTile && tile_size * resident < given.pair_count) tile_size *= 2;
  const int64_t tiles = (given.pair_count + tile_size - 1) / tile_size;
  const int64_t blocks = larger<int64_t>(1, smaller(tiles, resident));
  launch_kernel(context, shortened_pairs_kernel, static_cast<unsigned>(blocks), kBlockThreads, given, tile_size, found);
}

}  // namespace pgccd
