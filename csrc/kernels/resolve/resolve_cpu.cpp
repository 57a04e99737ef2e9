#include <vector>

#include "kernels/find_rows.h"
#include "kernels/resolve/resolve.h"

namespace pgccd {

void slow_all_down(const Executor& executor, const SlowAllDown& bodies, int64_t* changes) {
  int64_t chunks = 0;
  parallel_chunks(executor, bodies.count, 1024, [&](int, int64_t begin, int64_t end) {
    bool any = false;
    for (int64_t row = begin; row < end; ++row) any |= bodies.slow_down(row);
    if (any) add_shared(chunks, int64_t{1}, false);
  });
  if (chunks != 0) *changes = 1;
}

void lower_first_toi_of_bodies(const Executor& executor, const FirstToiInput& contacts, double* first) {
  require_rows(executor, contacts.count, "pairs", "are padding, or name bodies",
               [&](int64_t contact) { return contacts.is_sound(2 * contact) && contacts.is_sound(2 * contact + 1); });
  for (int64_t side = 0; side < 2 * contacts.count; ++side) {
    const int64_t body = contacts.pairs[side];
    if (body >= 0) first[body] = smaller(first[body], contacts.toi[side / 2]);
  }
}

void shortened_pairs(const Executor& executor, const ShortenedPairs& given) {
  require_rows(executor, given.pair_count, "pairs", "are padding, or name bodies",
               [&](int64_t pair) { return given.changed.is_sound(pair); });
  std::vector<int64_t> rows(static_cast<size_t>(given.pair_count));
  int64_t found = 0;
  find_rows(executor, given.pair_count, rows.data(), &found, given.changed);
  parallel_chunks(executor, found, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      for (int side = 0; side < 2; ++side) given.store(rows[static_cast<size_t>(k)], side, k);
    }
  });
  given.store_counts(found);
}

}  // namespace pgccd
