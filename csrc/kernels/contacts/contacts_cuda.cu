#include "kernels/contacts/contacts.h"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Memory for the faces and edges around contacts, and the most threads that share it.
constexpr int64_t kSurfaceBytes = int64_t{64} << 20, kMostThreads = int64_t{1} << 15;

// A thread stores what follows from `rows` contacts, one after the other, with memory for the surfaces of one.
template <class Out>
struct StoreInTurn {
  ContactsOnPaths given;
  Out out;
  int64_t rows;
  RingFace* faces;  // (threads, 2, most)
  RingEdge* edges;

  __device__ void operator()(int64_t thread) const {
    const int64_t most = given.incidence.most, end = smaller((thread + 1) * rows, given.contacts.count);
    Surfaces surfaces(faces + 2 * thread * most, edges + 2 * thread * most, most);
    for (int64_t row = thread * rows; row < end; ++row) out.store(given, row, surfaces);
  }
};

template <class Out>
void store_all(const DeviceContext& context, const ContactsOnPaths& given, const Out& out) {
  const int64_t count = given.contacts.count, most = given.incidence.most;
  if (count == 0) return;
  const int64_t bytes = 2 * most * static_cast<int64_t>(sizeof(RingFace) + sizeof(RingEdge));
  const int64_t room = larger<int64_t>(1, smaller(kMostThreads, kSurfaceBytes / larger<int64_t>(1, bytes)));
  const int64_t rows = (count + room - 1) / room, threads = (count + rows - 1) / rows;
  for_each_item(context, threads,
                StoreInTurn<Out>{given, out, rows, context.allocate<RingFace>(2 * threads * most),
                                 context.allocate<RingEdge>(2 * threads * most)});
}

}  // namespace

void closing_rates(const DeviceContext& context, const ContactsOnPaths& given, const ClosingRates& out) {
  for_each_item(context, given.contacts.count, [=] __device__(int64_t row) { out.store(given, row); });
}

void surface_normals(const DeviceContext& context, const ContactsOnPaths& given, const SurfaceNormals& out) {
  store_all(context, given, out);
}

void certainly_recede(const DeviceContext& context, const ContactsOnPaths& given, const CertainRecession& out) {
  store_all(context, given, out);
}

}  // namespace pgccd
