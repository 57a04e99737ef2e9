// Parts of a CUDA graph that a replay runs only if a value on the device is nonzero (CUDA's conditional nodes). The
// context's stream is being captured. Work captured on the stream `body` between the two calls becomes such a part.
#pragma once

#include "kernels/device_context.h"

namespace pgccd {

// Whether the CUDA that this was built with, and the driver, have conditional nodes.
bool has_conditional_nodes();

// The value (1,) is read by replays when they reach this part.
void begin_conditional(const DeviceContext& context, const int64_t* value, CUstream_st* body);

void end_conditional(CUstream_st* body);

}  // namespace pgccd
