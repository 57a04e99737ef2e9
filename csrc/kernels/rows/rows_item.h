// Selection of rows, and copies of a column's bytes.
#pragma once

#include <cstdint>
#include <cstring>

#include "core/count_leading.h"

namespace pgccd {

// A copy of rows of one column, as bytes. The source is two consecutive arrays; row -1 is zeros.
struct ColumnCopy {
  const uint8_t* first;
  const uint8_t* second;
  uint8_t* target;
  int64_t first_stride, second_stride, target_stride;  // bytes between rows
  uint32_t width;                                      // bytes of a row, at least 1

  // Null for a row of zeros.
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
  // -1 stands for a row of zeros.
  PGCCD_HD bool is_source(int64_t row) const { return row >= -1 && row < source_count; }
};

// Row k of the target: row k of the source's first array where a body is committed, else that of its second array.
struct CommittedRows {
  const int64_t* id;       // (count,) negative for padding
  const int64_t* discard;  // (1,) nonzero: nothing is committed
  int64_t count, first_count;

  PGCCD_HD int64_t operator()(int64_t row) const { return *discard == 0 && id[row] >= 0 ? row : first_count + row; }
  PGCCD_HD bool is_source(int64_t) const { return true; }
};

// A change of rows sorted by id: some removed, others added.
struct RowChange {
  const int64_t* id;  // (count,) ascending
  int64_t count;
  const int64_t* removed;  // (removed_count,) rows, ascending
  int64_t removed_count;
  const uint8_t* added;  // (added_count,) rows in any order, each beginning with its id
  int64_t added_stride;  // bytes between rows
  int64_t added_count;

  PGCCD_HD int64_t merged_count() const { return count - removed_count + added_count; }
  PGCCD_HD int64_t added_id(int64_t row) const {
    int64_t id;
    memcpy(&id, added + row * added_stride, sizeof(id));  // may be unaligned
    return id;
  }
  // New index of an id, given the number of smaller added ids.
  PGCCD_HD int64_t place(int64_t new_id, int64_t smaller_added) const {
    const int64_t smaller = count_leading(count, [&](int64_t row) { return id[row] < new_id; });
    return smaller - count_leading(removed_count, [&](int64_t k) { return removed[k] < smaller; }) + smaller_added;
  }
};

// Row k of the target is the k-th by id: a kept row, or an added one (which follow in the source).
struct MergedRows {
  RowChange change;
  const int64_t* places;  // (added_count,) new indices of added rows, ascending
  const int64_t* order;   // (added_count,) index of the added row at each of these
  int64_t count, first_count;

  // False if ids or removed rows do not ascend.
  PGCCD_HD bool is_source(int64_t row) const { return row >= 0 && row < change.count + change.added_count; }

  // Number of rows added before a row, and removed before it if it is kept.
  struct Before {
    int64_t added, removed;
  };
  PGCCD_HD bool is_added_before(int64_t k, int64_t row) const { return places[k] < row; }
  PGCCD_HD bool is_removed_before(int64_t k, int64_t kept) const { return change.removed[k] - k <= kept; }

  PGCCD_HD Before before(int64_t row) const {
    const int64_t added = count_leading(change.added_count, [&](int64_t k) { return is_added_before(k, row); });
    return {added, count_leading(change.removed_count, [&](int64_t k) { return is_removed_before(k, row - added); })};
  }
  // Advances the numbers to a later row.
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
