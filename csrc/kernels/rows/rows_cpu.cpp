#include <algorithm>
#include <array>
#include <numeric>
#include <stdexcept>

#include "kernels/rows/rows.h"

namespace pgccd {
namespace {

constexpr int64_t kChunkRows = 1024;
using Sources = std::array<int64_t, kChunkRows>;

// A width known at compile time makes a copy a few instructions; 0: known at run time only.
template <size_t kWidth>
void copy_column(const ColumnCopy& column, int64_t first_count, const Sources& sources, int64_t begin, int64_t end) {
  for (int64_t row = begin; row < end; ++row) {
    const uint8_t* source = column.source(sources[static_cast<size_t>(row - begin)], first_count);
    uint8_t* target = column.target + row * column.target_stride;
    const size_t width = kWidth == 0 ? column.width : kWidth;
    if (source == nullptr) {
      std::memset(target, 0, width);
    } else {
      std::memcpy(target, source, width);
    }
  }
}

auto copy_column_of(uint32_t width) {
  switch (width) {
    case 1:
      return copy_column<1>;
    case 4:
      return copy_column<4>;
    case 8:
      return copy_column<8>;
    case 24:
      return copy_column<24>;
    case 32:
      return copy_column<32>;
    default:
      return copy_column<0>;
  }
}

// find_sources(begin, end, sources): computes the sources of rows [begin, end).
template <class Rows, class FindSources>
void copy_chunks(const Executor& executor, const std::vector<ColumnCopy>& columns, const Rows& rows,
                 const char* expected, const FindSources& find_sources) {
  const int64_t first_count = rows.first_count;
  parallel_chunks(executor, rows.count, kChunkRows, [&](int, int64_t begin, int64_t end) {
    Sources sources;
    find_sources(begin, end, sources);
    for (int64_t row = begin; row < end; ++row) {
      if (!rows.is_source(sources[static_cast<size_t>(row - begin)])) throw std::invalid_argument(expected);
    }
    for (const ColumnCopy& column : columns) {
      copy_column_of(column.width)(column, first_count, sources, begin, end);
    }
  });
}

}  // namespace

void copy_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const ChosenRows& rows) {
  copy_chunks(executor, columns, rows, "rows: expected -1 or rows of the columns",
              [&](int64_t begin, int64_t end, Sources& sources) {
                for (int64_t row = begin; row < end; ++row) sources[static_cast<size_t>(row - begin)] = rows(row);
              });
}

void commit_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const CommittedRows& rows) {
  parallel_chunks(executor, rows.count, kChunkRows, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      if (rows(row) != row) continue;
      for (const ColumnCopy& column : columns) {
        std::memcpy(column.target + row * column.target_stride, column.source(row, rows.first_count), column.width);
      }
    }
  });
}

void merge_rows(const Executor& executor, const std::vector<ColumnCopy>& columns, const RowChange& change) {
  std::vector<int64_t> order(static_cast<size_t>(change.added_count)), places(order.size());
  std::iota(order.begin(), order.end(), int64_t{0});
  std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return change.added_id(a) < change.added_id(b); });
  parallel_chunks(executor, change.added_count, kChunkRows, [&](int, int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      const auto at = static_cast<size_t>(k);
      places[at] = change.place(change.added_id(order[at]), k);
    }
  });
  const MergedRows rows{change, places.data(), order.data(), change.merged_count(), change.count};
  copy_chunks(executor, columns, rows, "columns[0], removed: expected ids and rows in ascending order",
              [&](int64_t begin, int64_t end, Sources& sources) {
                MergedRows::Before known = rows.before(begin);
                for (int64_t row = begin; row < end; ++row) {
                  rows.advance(known, row);
                  sources[static_cast<size_t>(row - begin)] = rows.source(known, row);
                }
              });
}

}  // namespace pgccd
