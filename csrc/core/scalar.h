// Minimum, maximum and clamp by comparison: one instruction each, the same on every backend. A NaN in the first
// argument yields the second.
#pragma once

#include "core/platform.h"

namespace pgccd {

template <class T>
PGCCD_HD T larger(T a, T b) {
  return a > b ? a : b;
}
template <class T>
PGCCD_HD T smaller(T a, T b) {
  return a < b ? a : b;
}
// To [0, 1]; NaN becomes 0.
template <class T>
PGCCD_HD T unit_clamp(T x) {
  return smaller(larger(x, T(0)), T(1));
}

}  // namespace pgccd
