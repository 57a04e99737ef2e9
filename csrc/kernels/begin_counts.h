// The counts of a padded step start with those of the stage before it.
#pragma once

#include <cstdint>

namespace pgccd {

struct DeviceContext;

// `count` numbers on their way within a device.
struct CountSpan {
  const int64_t* from;
  int64_t count;
  int64_t* to;
};

// Copies both and notes the time.
void begin_counts_cuda(const DeviceContext& context, const CountSpan& first, const CountSpan& second, int64_t* time);

}  // namespace pgccd
