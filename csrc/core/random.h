// Counter-based random numbers: a pure function of a key and a counter, so that a body's numbers are the same on every
// device, thread and rank. Philox4x32-10 (Salmon, Moraes, Dror & Shaw 2011, doi:10.1145/2063384.2063405).
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

struct RandomBits {
  uint32_t word[4];
};

struct RandomCounter {
  int64_t id;
  uint32_t step;
  uint32_t stream;  // distinguishes the draws of one id in one step
};

PGCCD_HD RandomBits random_bits(uint64_t seed, RandomCounter counter) {
  uint32_t key_low = static_cast<uint32_t>(seed), key_high = static_cast<uint32_t>(seed >> 32);
  const uint64_t id = static_cast<uint64_t>(counter.id);
  RandomBits x{{static_cast<uint32_t>(id), static_cast<uint32_t>(id >> 32), counter.step, counter.stream}};
  for (int round = 0; round < 10; ++round) {
    const uint64_t product_0 = uint64_t{0xD2511F53u} * x.word[0];
    const uint64_t product_2 = uint64_t{0xCD9E8D57u} * x.word[2];
    x = {{static_cast<uint32_t>(product_2 >> 32) ^ x.word[1] ^ key_low, static_cast<uint32_t>(product_2),
          static_cast<uint32_t>(product_0 >> 32) ^ x.word[3] ^ key_high, static_cast<uint32_t>(product_0)}};
    key_low += 0x9E3779B9u;
    key_high += 0xBB67AE85u;
  }
  return x;
}

struct Uniforms {
  double u[4];  // in (0, 1), odd multiples of 2^-33
};

PGCCD_HD Uniforms random_uniforms(uint64_t seed, RandomCounter counter) {
  const RandomBits bits = random_bits(seed, counter);
  Uniforms out;
  for (int k = 0; k < 4; ++k) out.u[k] = (static_cast<double>(bits.word[k]) + 0.5) * 0x1p-32;
  return out;
}

}  // namespace pgccd
