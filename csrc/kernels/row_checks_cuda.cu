#include "kernels/launch.cuh"
#include "kernels/row_checks_cuda.h"

namespace pgccd {

template <class Bodies>
void require_candidates_cuda(const DeviceContext& context, const Bodies& bodies, const NamedPairs& pairs,
                             const Candidate* candidates, int64_t count) {
  if (count == 0) return;
  int32_t* is_unsound = context.allocate<int32_t>(1);
  fill_bytes(context, is_unsound, 0, 1);
  for_each_item(context, count, [=] __device__(int64_t k) {
    if (!names_features(bodies, pairs, candidates[k])) *is_unsound = 1;
  });
  if (read(context, is_unsound) != 0) {
    throw std::invalid_argument("candidates: expected rows that name pairs, kinds and features that are there");
  }
}

template void require_candidates_cuda(const DeviceContext&, const RigidBodies&, const NamedPairs&, const Candidate*,
                                      int64_t);
template void require_candidates_cuda(const DeviceContext&, const DeformingBodies&, const NamedPairs&, const Candidate*,
                                      int64_t);

void require_owners_cuda(const DeviceContext& context, const int64_t* owners, const int64_t* given, int64_t most,
                         int64_t limit) {
  for_each_counted(context, given, most, [=] __device__(int64_t k) {
    require_on_device(is_within(owners[2 * k], limit) && is_within(owners[2 * k + 1], limit),
                      "owners: expected rows of first");
  });
}

}  // namespace pgccd
