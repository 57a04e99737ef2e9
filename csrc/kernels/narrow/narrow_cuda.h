// Narrow phase on the device.
#pragma once

#include "kernels/device_context.h"
#include "kernels/narrow/narrow.h"

namespace pgccd {

template <class Bodies>
void narrow_phase_cuda(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                       const ContactOutput& make_output);

// As narrow_phase_cuda, without synchronising. Unused rows of `out` are filled: pair and features -1, toi infinite, the
// rest 0.
template <class Bodies>
void narrow_phase_padded(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                         const ContactCapacity& capacity, const ContactColumns& out, int64_t* counts);

// Lowers the first toi of the owners of each pair; writes no contacts. kContactsNeeded counts pairs with a contact;
// unresolved ones are not counted separately.
template <class Bodies>
void lower_first_toi(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input, int64_t most_open,
                     const FirstToi& known, int64_t* counts);

template <bool kEdgeEdge, class T>
void elementary_cuda(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                     const NarrowSettings& settings, const ElementaryColumns<T>& out);

}  // namespace pgccd
