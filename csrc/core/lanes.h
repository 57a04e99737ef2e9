// Loading of lanes, and reductions over them. Devices use the versions for float.
#pragma once

#include <cstdint>

#include "core/vec3.h"

namespace pgccd {

PGCCD_HD bool all_lanes(bool mask) { return mask; }
PGCCD_HD bool any_lane(bool mask) { return mask; }

// `a` where the mask is set, else `b`.
template <class T>
PGCCD_HD T select(bool mask, const T& a, const T& b) {
  return mask ? a : b;
}

// The same vector in each lane of the second argument's type.
PGCCD_HD Vec3<float> in_all_lanes(Vec3<float> v, float) { return v; }

// One whole number per lane. lane_numbers: 0, 1, 2, ...
PGCCD_HD int32_t lane_numbers(float) { return 0; }
PGCCD_HD int32_t to_integer(float x) { return static_cast<int32_t>(x); }
PGCCD_HD float to_number(int32_t n) { return static_cast<float>(n); }
PGCCD_HD int32_t load_at(const int32_t* first, int32_t place) { return first[place]; }

template <class T>
PGCCD_HD T load(const float* first) {
  return *first;
}

// The first three columns of rows of four numbers, one row per lane.
template <class T>
Vec3<T> three_columns(const float* const (&rows)[kLanes]);

#if !defined(__CUDACC__)

template <>
inline Float8 load<Float8>(const float* first) {
  Float8 out;
  __builtin_memcpy(&out, first, sizeof(out));
  return out;
}

template <>
inline Vec3<Float8> three_columns<Float8>(const float* const (&rows)[kLanes]) {
  using Float4 = float __attribute__((vector_size(16)));
  Float8 both[4];  // rows k and k + 4
  for (int k = 0; k < 4; ++k) {
    Float4 low, high;
    __builtin_memcpy(&low, rows[k], sizeof(low));
    __builtin_memcpy(&high, rows[k + 4], sizeof(high));
    both[k] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
  }
  const auto pairs_xy = [](Float8 a, Float8 b) { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); };
  const auto pairs_z = [](Float8 a, Float8 b) { return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); };
  const auto first = [](Float8 a, Float8 b) { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); };
  const auto second = [](Float8 a, Float8 b) { return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
  const Float8 xy01 = pairs_xy(both[0], both[1]), xy23 = pairs_xy(both[2], both[3]);
  return {first(xy01, xy23), second(xy01, xy23), first(pairs_z(both[0], both[1]), pairs_z(both[2], both[3]))};
}

inline Vec3<Float8> broadcast(Vec3<float> v) { return {v.x - Float8{}, v.y - Float8{}, v.z - Float8{}}; }

inline Vec3<Float8> in_all_lanes(Vec3<float> v, Float8) { return broadcast(v); }

inline uint32_t lane_bits(Mask8 mask) {
#if defined(__AVX__)
  return static_cast<uint32_t>(__builtin_ia32_movmskps256(__builtin_bit_cast(Float8, mask)));
#else
  uint32_t bits = 0;
  for (int lane = 0; lane < kLanes; ++lane) bits |= static_cast<uint32_t>(mask[lane] & 1) << lane;
  return bits;
#endif
}
// A mask of the lanes whose bits are not set.
inline Mask8 lanes_without(uint32_t bits) {
  const Mask8 bit{1, 2, 4, 8, 16, 32, 64, 128};
  return (bit & (static_cast<int32_t>(bits) - Mask8{})) == 0;
}
inline Float8 select(Mask8 mask, Float8 a, Float8 b) { return mask ? a : b; }
inline Vec3<Float8> select(Mask8 mask, const Vec3<Float8>& a, const Vec3<Float8>& b) {
  return {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z};
}
inline Mask8 lane_numbers(Float8) { return Mask8{0, 1, 2, 3, 4, 5, 6, 7}; }
inline Mask8 to_integer(Float8 x) { return __builtin_convertvector(x, Mask8); }
inline Float8 to_number(Mask8 n) { return __builtin_convertvector(n, Float8); }
inline Mask8 load_at(const int32_t* first, Mask8 place) {
  Mask8 out;
  for (int lane = 0; lane < kLanes; ++lane) out[lane] = first[place[lane]];
  return out;
}
inline float largest_lane(Float8 x) {
  x = larger(x, __builtin_shuffle(x, Mask8{4, 5, 6, 7, 0, 1, 2, 3}));
  x = larger(x, __builtin_shuffle(x, Mask8{2, 3, 0, 1, 6, 7, 4, 5}));
  return larger(x[0], x[1]);
}
inline bool any_lane(Mask8 mask) { return lane_bits(mask) != 0; }
inline bool all_lanes(Mask8 mask) { return lane_bits(mask) == (1u << kLanes) - 1; }

#endif

}  // namespace pgccd
