#include "kernels/narrow/narrow_cuda.h"
#include "kernels/pipeline/pipeline_cuda.h"
#include "kernels/traverse/traverse_cuda.h"

namespace pgccd {
namespace {

template <class Bodies>
NarrowInput traversed(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search) {
  NarrowInput narrow = search.narrow;
  narrow.candidates = traverse_padded(context, bodies, search.traversal, search.pair_count, search.traverse_capacity,
                                      search.traverse_counts);
  return narrow;
}

}  // namespace

template <class Bodies>
void find_contacts_cuda(const DeviceContext& context, const Bodies& bodies, const ContactSearch& search,
                        const ContactOutput& make_output) {
  const NarrowInput narrow = traversed(context, bodies, search);
  narrow_phase_padded(context, bodies, narrow, search.contact_capacity, make_output(search.contact_capacity.contacts),
                      search.contact_counts);
}

void lower_first_toi_cuda(const DeviceContext& context, const RigidBodies& bodies, const ContactSearch& search,
                          const FirstToi& known) {
  const NarrowInput narrow = traversed(context, bodies, search);
  lower_first_toi(context, bodies, narrow, search.contact_capacity.open, known, search.contact_counts);
}

template void find_contacts_cuda(const DeviceContext&, const RigidBodies&, const ContactSearch&, const ContactOutput&);
template void find_contacts_cuda(const DeviceContext&, const DeformingBodies&, const ContactSearch&,
                                 const ContactOutput&);

}  // namespace pgccd
