#include <vector>

#include "kernels/contacts/contacts.h"

namespace pgccd {
namespace {

constexpr int64_t kGrain = 256;

// Stores what follows from all contacts; each chunk has memory for the surfaces of one.
template <class Out>
void store_all(const Executor& executor, const ContactsOnPaths& given, const Out& out) {
  parallel_chunks(executor, given.contacts.count, kGrain, [&](int, int64_t begin, int64_t end) {
    std::vector<RingFace> faces(static_cast<size_t>(2 * given.incidence.most));
    std::vector<RingEdge> edges(faces.size());
    Surfaces surfaces(faces.data(), edges.data(), given.incidence.most);
    for (int64_t row = begin; row < end; ++row) out.store(given, row, surfaces);
  });
}

}  // namespace

void closing_rates(const Executor& executor, const ContactsOnPaths& given, const ClosingRates& out) {
  parallel_chunks(executor, given.contacts.count, kGrain, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) out.store(given, row);
  });
}

void surface_normals(const Executor& executor, const ContactsOnPaths& given, const SurfaceNormals& out) {
  store_all(executor, given, out);
}

void certainly_recede(const Executor& executor, const ContactsOnPaths& given, const CertainRecession& out) {
  store_all(executor, given, out);
}

}  // namespace pgccd
