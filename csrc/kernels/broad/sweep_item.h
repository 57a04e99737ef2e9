// Sweep and prune along one axis: sort keys.
#pragma once

#include <bit>

#include "kernels/broad/body_volumes.h"

namespace pgccd {

// Unsigned integers with the same order as the floats.
PGCCD_HD uint32_t ordered_bits(float x) {
  const uint32_t bits = std::bit_cast<uint32_t>(x);
  return (bits & 0x80000000u) ? ~bits : (bits | 0x80000000u);
}

// Above the key of any number, also in its lower half.
constexpr uint64_t kBehindAll = ~uint64_t{0};

// The world in the upper bits: intervals of different worlds never overlap, so one sort sweeps all worlds separately.
PGCCD_HD uint64_t sweep_key(const BroadBodies& bodies, int64_t body, float position) {
  if (bodies.is_absent(body)) return kBehindAll;
  const uint32_t world = bodies.world ? static_cast<uint32_t>(bodies.world[body]) : 0u;
  return (static_cast<uint64_t>(world) << 32) | ordered_bits(position);
}

}  // namespace pgccd
