// Bit operations on integers: not every device compiler supports those of the standard library.
#pragma once

#include <bit>
#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Number of bits needed for x; 0 for 0.
PGCCD_HD int bit_width(uint64_t x) {
#if defined(__CUDA_ARCH__)
  return 64 - __clzll(static_cast<long long>(x));
#else
  return static_cast<int>(std::bit_width(x));
#endif
}

// Position of the lowest set bit of x, which must not be 0.
PGCCD_HD int lowest_bit(uint64_t x) {
#if defined(__CUDA_ARCH__)
  return __ffsll(static_cast<long long>(x)) - 1;
#else
  return std::countr_zero(x);
#endif
}

}  // namespace pgccd
