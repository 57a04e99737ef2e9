// The share of a device that the operators of a thread take.
#pragma once

namespace pgccd::bind {

// As DeviceContext::share, of this thread's operators; 1 at first.
int& device_share();

}  // namespace pgccd::bind
