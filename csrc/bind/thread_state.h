// What a thread's operators on a device share, and the thread may ask for or set.
#pragma once

#include <cstdint>

namespace pgccd::bind {

// Most bytes of scratch memory that one operator has held since this was last set to 0.
int64_t& scratch_peak();

// As DeviceContext::share; 1 at first.
int& device_share();

}  // namespace pgccd::bind
