#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <algorithm>
#include <cub/cub.cuh>

#include "kernels/launch.cuh"
#include "kernels/rows/rows.h"

namespace pgccd {
namespace {

constexpr size_t kGroupColumns = 16;  // columns per launch
constexpr int64_t kTileRows = 32;     // rows that a block copies at a time

// Columns by value: nothing has to be copied to the device before a launch.
struct ColumnGroup {
  ColumnCopy columns[kGroupColumns];
  uint32_t word_bytes[kGroupColumns];        // 8, 4 or 1
  uint32_t words_before[kGroupColumns + 1];  // words per row in the columns before each, and in total
};

// The largest word size that divides all addresses, strides and the width.
uint32_t word_bytes(const ColumnCopy& column) {
  const auto address = [](const void* pointer) { return reinterpret_cast<uintptr_t>(pointer); };
  const uintptr_t pointers = address(column.first) | address(column.second) | address(column.target);
  const int64_t strides = column.first_stride | column.second_stride | column.target_stride;
  const uintptr_t bits = pointers | static_cast<uintptr_t>(strides) | column.width;
  return bits % 8 == 0 ? 8 : bits % 4 == 0 ? 4 : 1;
}

ColumnGroup group_of(const std::vector<ColumnCopy>& columns, size_t begin, size_t count) {
  ColumnGroup group{};
  for (size_t k = 0; k < count; ++k) {
    const ColumnCopy& column = group.columns[k] = columns[begin + k];
    group.word_bytes[k] = word_bytes(column);
    group.words_before[k + 1] = group.words_before[k] + column.width / group.word_bytes[k];
  }
  return group;
}

template <class Word>
__device__ void copy_word(const uint8_t* source, uint8_t* target, uint32_t word) {
  reinterpret_cast<Word*>(target)[word] = source == nullptr ? Word{0} : reinterpret_cast<const Word*>(source)[word];
}

// A block computes the sources of its tile's rows once for all columns. Neighbouring threads then copy neighbouring
// words of the same column.
template <class Rows>
__global__ void __launch_bounds__(kBlockThreads)
    copy_rows_kernel(const __grid_constant__ ColumnGroup group, const uint32_t row_words, const Rows rows) {
  wait_for_previous_kernels();
  __shared__ int64_t sources[kTileRows];
  const int64_t stride = kTileRows * static_cast<int64_t>(gridDim.x);
  for (int64_t begin = kTileRows * static_cast<int64_t>(blockIdx.x); begin < rows.count; begin += stride) {
    const auto tile_rows = static_cast<uint32_t>(smaller(kTileRows, rows.count - begin));
    if (threadIdx.x < tile_rows) {
      const int64_t source = rows(begin + threadIdx.x);
      require_on_device(rows.is_source(source), "rows, or ids and rows removed: expected rows of the columns");
      sources[threadIdx.x] = source;
    }
    __syncthreads();
    uint32_t k = 0;  // a thread's words ascend, and so do their columns
    for (uint32_t item = threadIdx.x; item < tile_rows * row_words; item += kBlockThreads) {
      while (item >= tile_rows * group.words_before[k + 1]) ++k;
      const ColumnCopy& column = group.columns[k];
      const uint32_t column_words = group.words_before[k + 1] - group.words_before[k];
      const uint32_t within = item - tile_rows * group.words_before[k];
      const uint32_t row = within / column_words, word = within - row * column_words;
      const uint8_t* source = column.source(sources[row], rows.first_count);
      uint8_t* target = column.target + (begin + row) * column.target_stride;
      if (group.word_bytes[k] == 8) {
        copy_word<uint64_t>(source, target, word);
      } else if (group.word_bytes[k] == 4) {
        copy_word<uint32_t>(source, target, word);
      } else {
        copy_word<uint8_t>(source, target, word);
      }
    }
    __syncthreads();  // before the next tile's sources are written
  }
}

template <class Rows>
void launch_copies(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const Rows& rows) {
  if (rows.count == 0) return;
  constexpr int64_t kMostBlocks = int64_t{1} << 20;
  const auto blocks = static_cast<unsigned>(smaller((rows.count + kTileRows - 1) / kTileRows, kMostBlocks));
  for (size_t begin = 0; begin < columns.size(); begin += kGroupColumns) {
    const size_t count = std::min(kGroupColumns, columns.size() - begin);
    const ColumnGroup group = group_of(columns, begin, count);
    launch_kernel(context, copy_rows_kernel<Rows>, blocks, kBlockThreads, group, group.words_before[count], rows);
  }
}

}  // namespace

void commit_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const CommittedRows& rows) {
  launch_copies(context, columns, rows);
}

namespace {

struct AddedId {
  RowChange change;
  __device__ int64_t operator()(int64_t row) const { return change.added_id(row); }
};

struct Ascending {
  __host__ __device__ bool operator()(int64_t a, int64_t b) const { return a < b; }
};

}  // namespace

void copy_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const ChosenRows& rows) {
  launch_copies(context, columns, rows);
}

void merge_rows(const DeviceContext& context, const std::vector<ColumnCopy>& columns, const RowChange& change) {
  const int64_t added_count = change.added_count;
  int64_t* places = context.allocate<int64_t>(added_count);
  int64_t* order = context.allocate<int64_t>(added_count);
  if (added_count > 0) {
    // Merge sort: few rows are added, for which a 64-bit radix sort needs more launches.
    int64_t* id = context.allocate<int64_t>(added_count);
    const thrust::counting_iterator<int64_t> row(0);
    const auto unsorted = thrust::make_transform_iterator(row, AddedId{change});
    run_cub(context, [&](void* scratch, size_t& bytes) {
      return cub::DeviceMergeSort::SortPairsCopy(scratch, bytes, unsorted, row, id, order, added_count, Ascending{},
                                                 context.stream);
    });
    for_each_item(context, added_count, [=] __device__(int64_t k) { places[k] = change.place(id[k], k); });
  }
  launch_copies(context, columns, MergedRows{change, places, order, change.merged_count(), change.count});
}

}  // namespace pgccd
