// Which rows come where, and a column's bytes on their way.
#pragma once

#include <cstdint>
#include <cstring>

#include "core/count_leading.h"

namespace pgccd {

// Rows of one column, copied as bytes: what they mean does not matter. The source is two arrays, one after the other;
// row -1 is zeros.
struct ColumnCopy {
  const uint8_t* first;
  const uint8_t* second;
  uint8_t* target;
  int64_t first_stride, second_stride, target_stride;  // bytes from a row to the next
  uint32_t width;                                      // bytes of a row, at least 1

  // Null: zeros.
  PGCCD_HD const uint8_t* source(int64_t row, int64_t first_count) const {
    if (row < 0) return nullptr;
    return row < first_count ? first + row * first_stride : second + (row - first_count) * second_stride;
  }
};

// Row k of the target is row rows[k] of the source; row k itself if `rows` is null.
struct ChosenRows {
  const int64_t* rows;
  int64_t count, first_count, source_count;

  PGCCD_HD int64_t operator()(int64_t row) const { return rows == nullptr ? row : rows[row]; }
  // -1 is no row.
  PGCCD_HD bool is_source(int64_t row) const { return row >= -1 && row < source_count; }
};

// Rows by ascending id, of which some go and others come.
struct RowChange {
  const int64_t* id;  // (count,) ascending
  int64_t count;
  const int64_t* removed;  // (removed_count,) rows, ascending
  int64_t removed_count;
  const uint8_t* added;  // (added_count,) rows in any order, each beginning with its id
  int64_t added_stride;  // bytes from a row to the next
  int64_t added_count;

  PGCCD_HD int64_t merged_count() const { return count - removed_count + added_count; }
  PGCCD_HD int64_t added_id(int64_t row) const {
    int64_t id;
    memcpy(&id, added + row * added_stride, sizeof(id));  // which may lie anywhere
    return id;
  }
  // Where an id comes to be if so many of those added are smaller.
  PGCCD_HD int64_t place(int64_t new_id, int64_t smaller_added) const {
    const int64_t smaller = count_leading(count, [&](int64_t row) { return id[row] < new_id; });
    return smaller - count_leading(removed_count, [&](int64_t k) { return removed[k] < smaller; }) + smaller_added;
  }
};

// Row k of the target is what comes k-th by id: one of those kept, or (after them in the source) of those added.
struct MergedRows {
  RowChange change;
  const int64_t* places;  // (added_count,) of rows added, ascending
  const int64_t* order;   // (added_count,) which of the rows added each is
  int64_t count, first_count;

  // Not so if ids do not ascend, or rows removed.
  PGCCD_HD bool is_source(int64_t row) const { return row >= 0 && row < change.count + change.added_count; }

  // How many rows were added before a row, and how many removed before it if it is one of those kept.
  struct Before {
    int64_t added, removed;
  };
  PGCCD_HD bool is_added_before(int64_t k, int64_t row) const { return places[k] < row; }
  PGCCD_HD bool is_removed_before(int64_t k, int64_t kept) const { return change.removed[k] - k <= kept; }

  PGCCD_HD Before before(int64_t row) const {
    const int64_t added = count_leading(change.added_count, [&](int64_t k) { return is_added_before(k, row); });
    return {added, count_leading(change.removed_count, [&](int64_t k) { return is_removed_before(k, row - added); })};
  }
  // From the same of an earlier row.
  PGCCD_HD void advance(Before& known, int64_t row) const {
    while (known.added < change.added_count && is_added_before(known.added, row)) ++known.added;
    while (known.removed < change.removed_count && is_removed_before(known.removed, row - known.added)) ++known.removed;
  }
  PGCCD_HD int64_t source(const Before& known, int64_t row) const {
    const bool is_added = known.added < change.added_count && places[known.added] == row;
    return is_added ? first_count + order[known.added] : row - known.added + known.removed;
  }
  PGCCD_HD int64_t operator()(int64_t row) const { return source(before(row), row); }
};

}  // namespace pgccd
