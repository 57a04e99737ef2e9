#include <cub/cub.cuh>

#include "kernels/device.cuh"
#include "kernels/narrow/contact_item.h"
#include "kernels/narrow/narrow_cuda.h"

namespace pgccd {
namespace {

struct FoundContact {
  int32_t candidate;
  int32_t status;
  double toi, u, v;
};

struct FoundList {
  FoundContact* contacts;
  uint32_t* count;  // of what did not fit as well
  uint32_t capacity;
};

// toi >= 0, so its bits are in order; all ones is later than any.
__device__ unsigned long long toi_bits(double toi) {
  return static_cast<unsigned long long>(__double_as_longlong(toi));
}

// Kind and features in canonical order.
__device__ unsigned long long feature_key(const Candidate& c) {
  return (static_cast<unsigned long long>(c.kind) << 62) | (static_cast<unsigned long long>(c.feature_i) << 31) |
         static_cast<unsigned long long>(c.feature_j);
}

// One thread a candidate. Those certainly later than the pair's best so far are cut short, which cannot change the
// winner.
template <class Bodies>
__global__ void __launch_bounds__(kBlockThreads)
    solve_candidates(Bodies bodies, NarrowInput input, unsigned long long* best, FoundList found) {
  const int64_t c = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (c >= input.candidate_count) return;
  const Candidate candidate = input.candidates[c];
  double latest = INFINITY;
  if (best != nullptr) {
    const unsigned long long seen = *static_cast<volatile unsigned long long*>(best + candidate.pair);
    if (seen != ~0ull) {
      if (input.report == Report::kAny) return;
      latest = __longlong_as_double(static_cast<long long>(seen));
    }
  }
  const typename PairOf<Bodies>::type pair(bodies, input.pairs[2 * int64_t(candidate.pair)],
                                           input.pairs[2 * int64_t(candidate.pair) + 1]);
  const Outcome<double> outcome = solve_candidate(bodies, pair, candidate, input.settings, latest);
  if (outcome.status != Status::kTouch && outcome.status != Status::kUnresolved) return;
  if (best != nullptr) atomicMin(best + candidate.pair, toi_bits(outcome.toi));
  const uint32_t at = warp_append(found.count, 1);
  if (at < found.capacity) {
    found.contacts[at] = {static_cast<int32_t>(c), static_cast<int32_t>(outcome.status), outcome.toi, outcome.u,
                          outcome.v};
  }
}

template <class Bodies>
FoundList find_contacts(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                        unsigned long long* best, uint32_t& count) {
  uint32_t* counter = context.allocate<uint32_t>(1);
  uint32_t capacity = static_cast<uint32_t>(input.candidate_count / 4 + 4096);
  for (;;) {
    const FoundList found{context.allocate<FoundContact>(capacity), counter, capacity};
    fill_bytes(context, counter, 0, 1);
    if (best != nullptr) fill_bytes(context, best, 0xff, input.pair_count);
    const int64_t blocks = (input.candidate_count + kBlockThreads - 1) / kBlockThreads;
    solve_candidates<Bodies>
        <<<static_cast<unsigned>(blocks), kBlockThreads, 0, context.stream>>>(bodies, input, best, found);
    check_cuda(cudaGetLastError(), "solve_candidates");
    count = read(context, counter);
    if (count <= capacity) return found;
    capacity = count;
  }
}

// The rows of `found` to report, in canonical order: one a pair.
int32_t* select_first(const DeviceContext& context, const NarrowInput& input, const FoundList& found, uint32_t count,
                      const unsigned long long* best, int64_t& rows) {
  const Candidate* candidates = input.candidates;
  auto* best_key = context.allocate<unsigned long long>(input.pair_count);
  int32_t* winner = context.allocate<int32_t>(input.pair_count);
  fill_bytes(context, best_key, 0xff, input.pair_count);
  fill_bytes(context, winner, 0xff, input.pair_count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    const Candidate& c = candidates[found.contacts[k].candidate];
    if (toi_bits(found.contacts[k].toi) == best[c.pair]) atomicMin(best_key + c.pair, feature_key(c));
  });
  for_each_item(context, count, [=] __device__(int64_t k) {
    const Candidate& c = candidates[found.contacts[k].candidate];
    if (toi_bits(found.contacts[k].toi) == best[c.pair] && feature_key(c) == best_key[c.pair]) {
      winner[c.pair] = static_cast<int32_t>(k);
    }
  });
  int32_t* selected = context.allocate<int32_t>(input.pair_count);
  int64_t* selected_count = context.allocate<int64_t>(1);
  const auto has_winner = [] __device__(int32_t k) { return k >= 0; };
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceSelect::If(scratch, bytes, winner, selected, selected_count, input.pair_count, has_winner,
                                 context.stream);
  });
  rows = read(context, selected_count);
  return selected;
}

// All of them, sorted by pair, kind and features: two stable sorts, the less significant key first.
int32_t* sort_all(const DeviceContext& context, const NarrowInput& input, const FoundList& found, uint32_t count) {
  const Candidate* candidates = input.candidates;
  uint64_t* keys = context.allocate<uint64_t>(count);
  uint64_t* sorted_keys = context.allocate<uint64_t>(count);
  int32_t* order = context.allocate<int32_t>(count);
  int32_t* sorted_order = context.allocate<int32_t>(count);
  for_each_item(context, count, [=] __device__(int64_t k) {
    keys[k] = feature_key(candidates[found.contacts[k].candidate]);
    order[k] = static_cast<int32_t>(k);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, order, sorted_order,
                                           static_cast<int64_t>(count), 0, 64, context.stream);
  });
  for_each_item(context, count, [=] __device__(int64_t k) {
    keys[k] = static_cast<uint64_t>(candidates[found.contacts[sorted_order[k]].candidate].pair);
  });
  run_cub(context, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, sorted_order, order,
                                           static_cast<int64_t>(count), 0, 32, context.stream);
  });
  return order;
}

template <class Bodies>
void write_rows(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input, const FoundList& found,
                const int32_t* selected, int64_t rows, const ContactColumns& out) {
  for_each_item(context, rows, [=] __device__(int64_t row) {
    const FoundContact& contact = found.contacts[selected[row]];
    const Candidate c = input.candidates[contact.candidate];
    const typename PairOf<Bodies>::type pair(bodies, input.pairs[2 * int64_t(c.pair)],
                                             input.pairs[2 * int64_t(c.pair) + 1]);
    const ContactPlace at = contact_place(bodies, pair, c, contact.toi, contact.u, contact.v);
    out.pair[row] = c.pair;
    out.kind[row] = static_cast<int8_t>(c.kind);
    out.features[2 * row] = c.feature_i;
    out.features[2 * row + 1] = c.feature_j;
    out.status[row] = static_cast<int8_t>(contact.status);
    out.toi[row] = contact.toi;
    out.coordinates[2 * row] = contact.u;
    out.coordinates[2 * row + 1] = contact.v;
    store_vec3(out.point + 3 * row, at.point);
    store_vec3(out.normal + 3 * row, at.normal);
  });
}

}  // namespace

template <class Bodies>
void narrow_phase_cuda(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                       const ContactOutput& make_output) {
  if (input.candidate_count == 0 || input.pair_count == 0) {
    make_output(0);
    return;
  }
  auto* best = input.report == Report::kAll ? nullptr : context.allocate<unsigned long long>(input.pair_count);
  uint32_t count = 0;
  const FoundList found = find_contacts(context, bodies, input, best, count);
  int64_t rows = count;
  if (rows == 0) {
    make_output(0);
    return;
  }
  const int32_t* selected =
      best != nullptr ? select_first(context, input, found, count, best, rows) : sort_all(context, input, found, count);
  write_rows(context, bodies, input, found, selected, rows, make_output(rows));
}

template void narrow_phase_cuda(const DeviceContext&, const RigidBodies&, const NarrowInput&, const ContactOutput&);
template void narrow_phase_cuda(const DeviceContext&, const DeformingBodies&, const NarrowInput&, const ContactOutput&);

template <bool kEdgeEdge, class T>
void elementary_cuda(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                     const NarrowSettings& settings, const ElementaryColumns<T>& out) {
  for_each_item(context, count, [=] __device__(int64_t q) {
    const T *start = points_t0 + 12 * q, *end = points_t1 + 12 * q;
    const bool free = stays_apart<kEdgeEdge>(rounded_differences<kEdgeEdge>(start), rounded_differences<kEdgeEdge>(end),
                                             cull_distance(settings));
    store(out, q, free ? culled_answer<T>() : solve_elementary<kEdgeEdge>(start, end, settings));
  });
}

template void elementary_cuda<false>(const DeviceContext&, const float*, const float*, int64_t, const NarrowSettings&,
                                     const ElementaryColumns<float>&);
template void elementary_cuda<true>(const DeviceContext&, const float*, const float*, int64_t, const NarrowSettings&,
                                    const ElementaryColumns<float>&);
template void elementary_cuda<false>(const DeviceContext&, const double*, const double*, int64_t, const NarrowSettings&,
                                     const ElementaryColumns<double>&);
template void elementary_cuda<true>(const DeviceContext&, const double*, const double*, int64_t, const NarrowSettings&,
                                    const ElementaryColumns<double>&);

}  // namespace pgccd
