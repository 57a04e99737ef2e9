// The most scratch memory that one operator has held on a device.
#pragma once

#include <cstdint>

namespace pgccd::bind {

// Bytes, of this thread's operators since somebody last set it to 0.
int64_t& scratch_peak();

}  // namespace pgccd::bind
