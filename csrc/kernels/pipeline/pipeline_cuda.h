// The order of stages on the device: contracts as in pipeline.h. Does not synchronise; all lists have given capacities.
#pragma once

#include "kernels/device_context.h"
#include "kernels/pipeline/contact_search.h"

namespace pgccd {

template <class Bodies>
void find_contacts_cuda(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                        const ContactOutput& make_output);

void lower_first_toi_cuda(const DeviceContext& context, const RigidBodies& bodies, const ContactSearch& search,
                          const FirstToi& known);

}  // namespace pgccd
