// The hash of one row of columns; rows are summed modulo 2^64, so that neither their order nor who holds them matters.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Columns of 8-byte numbers, floating-point ones as their bits.
struct HashColumns {
  static constexpr int kMost = 8;
  const uint64_t* column[kMost];
  int64_t width[kMost];  // numbers a row
  int columns;
  int64_t count;  // rows
};

// SplitMix64 (Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195).
PGCCD_HD uint64_t mix(uint64_t bits) {
  bits += 0x9e3779b97f4a7c15u;
  bits = (bits ^ (bits >> 30)) * 0xbf58476d1ce4e5b9u;
  bits = (bits ^ (bits >> 27)) * 0x94d049bb133111ebu;
  return bits ^ (bits >> 31);
}

PGCCD_HD uint64_t row_hash(const HashColumns& columns, int64_t row) {
  uint64_t hash = 0;
  for (int k = 0; k < columns.columns; ++k) {
    const int64_t width = columns.width[k];
    for (int64_t at = 0; at < width; ++at) hash = mix(hash ^ columns.column[k][row * width + at]);
  }
  return hash;
}

}  // namespace pgccd
