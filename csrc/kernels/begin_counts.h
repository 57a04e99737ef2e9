// Initialises the counts of a padded step with those of the previous stage.
#pragma once

#include <cstdint>

namespace pgccd {

struct DeviceContext;

// A copy of `count` values within a device.
struct CountSpan {
  const int64_t* from;
  int64_t count;
  int64_t* to;
};

// Copies both spans and records the time.
void begin_counts_cuda(const DeviceContext& context, const CountSpan& first, const CountSpan& second, int64_t* time);

}  // namespace pgccd
