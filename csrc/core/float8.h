// Eight floats at a time, on the host: a compiler vector type with the operations of core/scalar.h. Templates written
// for float accept it, with the same bits in each lane.
#pragma once

#include <cstdint>

#include "core/scalar.h"

namespace pgccd {

constexpr int kLanes = 8;

#if !defined(__CUDACC__)

using Float8 = float __attribute__((vector_size(32)));
using Mask8 = int32_t __attribute__((vector_size(32)));

inline Float8 multiply_add(Float8 a, Float8 b, Float8 c) {
#if defined(__FMA__)
  return __builtin_ia32_vfmaddps256(a, b, c);
#else
  Float8 out;
  for (int lane = 0; lane < kLanes; ++lane) out[lane] = std::fma(a[lane], b[lane], c[lane]);
  return out;
#endif
}
inline Float8 multiply_add(float a, Float8 b, Float8 c) { return multiply_add(a - Float8{}, b, c); }

inline Float8 unit_clamp(Float8 x) { return smaller(larger(x, Float8{}), Float8{} + 1.0f); }

inline Float8 square_root(Float8 x) {
  Float8 out;
  for (int lane = 0; lane < kLanes; ++lane) out[lane] = std::sqrt(x[lane]);
  return out;
}

#endif

}  // namespace pgccd
