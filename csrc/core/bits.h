// Bits of integers: the standard library's functions are not translated by every device compiler.
#pragma once

#include <bit>
#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Of the smallest field that holds x; 0 for 0.
PGCCD_HD int bit_width(uint64_t x) {
#if defined(__CUDA_ARCH__)
  return 64 - __clzll(static_cast<long long>(x));
#else
  return static_cast<int>(std::bit_width(x));
#endif
}

// Position of the lowest bit of x, which is not 0.
PGCCD_HD int lowest_bit(uint64_t x) {
#if defined(__CUDA_ARCH__)
  return __ffsll(static_cast<long long>(x)) - 1;
#else
  return std::countr_zero(x);
#endif
}

}  // namespace pgccd
