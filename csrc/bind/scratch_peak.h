// The most scratch memory that one operator has held on a device.
#pragma once

#include <cstdint>

namespace pgccd::bind {

// Bytes; the largest use by this thread's operators since it was last set to 0.
int64_t& scratch_peak();

}  // namespace pgccd::bind
