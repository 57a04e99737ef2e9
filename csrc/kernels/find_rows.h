// Rows that fulfil a condition, in order.
#pragma once

#include <vector>

#include "kernels/executor.h"

namespace pgccd {

// rows (count,): the rows found come first; found (1,) is their number.
template <class IsWanted>
void find_rows(const Executor& executor, int64_t count, int64_t* rows, int64_t* found, IsWanted&& is_wanted) {
  std::vector<uint8_t> wanted(static_cast<size_t>(count));
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) wanted[static_cast<size_t>(row)] = is_wanted(row);
  });
  int64_t at = 0;
  for (int64_t row = 0; row < count; ++row) {
    if (wanted[static_cast<size_t>(row)]) rows[at++] = row;
  }
  *found = at;
}

}  // namespace pgccd
