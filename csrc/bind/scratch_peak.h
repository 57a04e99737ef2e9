// Peak scratch memory of one operator on a device.
#pragma once

#include <cstdint>

namespace pgccd::bind {

// In bytes; maximum over this thread's operators since it was last set to 0.
int64_t& scratch_peak();

}  // namespace pgccd::bind
