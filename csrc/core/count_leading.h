#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Number of leading items of [0, count) that fulfil a condition that is false for all items after the first for which
// it is false.
template <class Condition>
PGCCD_HD int64_t count_leading(int64_t count, const Condition& condition) {
  int64_t begin = 0;
  while (count > 0) {
    const int64_t half = count / 2;
    if (condition(begin + half)) {
      begin += half + 1;
      count -= half + 1;
    } else {
      count = half;
    }
  }
  return begin;
}

}  // namespace pgccd
