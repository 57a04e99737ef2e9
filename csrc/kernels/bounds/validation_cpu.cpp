#include <atomic>
#include <limits>

#include "kernels/bounds/validation.h"

namespace pgccd {

void first_invalid_rows(const Executor& executor, const std::vector<RowColumn>& columns, const SoundRadii& radii,
                        int64_t* first) {
  constexpr int64_t kGrain = 4096;
  parallel_chunks(executor, radii.count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) radii.out[body] = radius_of(radii, body);
  });
  bool any = false;
  for (size_t k = 0; k < columns.size(); ++k) {
    const RowColumn& column = columns[k];
    std::atomic<int64_t> least{column.rows};
    parallel_chunks(executor, column.rows, kGrain, [&](int, int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) {
        if (!is_invalid(column, row)) continue;
        int64_t seen = least.load();
        while (row < seen && !least.compare_exchange_weak(seen, row)) {
        }
        if (radii.out == nullptr) return;
        radii.out[row] = -std::numeric_limits<double>::infinity();
      }
    });
    first[k] = least;
    any |= first[k] < column.rows;
  }
  first[columns.size()] = any;
}

}  // namespace pgccd
