// What follows from contacts: how fast their gaps close, the normals of the surfaces, and which certainly recede. Rows
// of contacts are independent of one another. Rows that name no features of the bodies are not read through: they have
// rates of NaN, keep their normals and do not recede.
#pragma once

#include "kernels/contacts/recession_item.h"
#include "kernels/contacts/surface_item.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

// Contacts, their bodies on their paths, and (count, 3) unit normals from i to j.
struct ContactsOnPaths {
  BodyPaths paths;
  Incidence incidence;
  ContactInput contacts;
  const double* normal;

  PGCCD_HD bool exists(int64_t row) const { return Site::exists(paths, contacts, row); }
  PGCCD_HD Site site(int64_t row) const { return Site::of(paths, incidence, contacts, row); }
  PGCCD_HD Vec3<double> normal_of(int64_t row) const { return load_vec3(normal + 3 * row); }
};

struct ClosingRates {
  double* rate;          // (contacts,) at which the gap closes at toi, per step
  uint8_t* is_reversed;  // (contacts,) whether the normal pointed to the wrong side
  double* away;          // (contacts,) of the contact's point from halfway between the nearest points of its features
  double* size;          // (contacts,) of what was added for that

  PGCCD_HD void store(const ContactsOnPaths& given, int64_t row) const {
    using namespace contacts_detail;
    rate[row] = away[row] = size[row] = NAN;
    is_reversed[row] = 0;
    if (!given.exists(row)) return;
    const Site site = given.site(row);
    const Vec3<double> normal = given.normal_of(row);
    const double closing = -dot_of(normal, site.velocity());
    is_reversed[row] = site.is_reversed(normal) ? 1 : 0;
    rate[row] = is_reversed[row] != 0 ? -closing : closing;
    const Vec3<double> arms = (site.nearest[0] - site.arm_of_point(0)) + (site.nearest[1] - site.arm_of_point(1));
    away[row] = length_of(0.5 * arms);
    size[row] = site.noise / kNoise + length_of(site.point);
  }
};

void closing_rates(const Executor& executor, const ContactsOnPaths& given, const ClosingRates& out);
void closing_rates(const DeviceContext& context, const ContactsOnPaths& given, const ClosingRates& out);

struct SurfaceNormals {
  double* normal;  // (contacts, 3) unit normals of the surfaces, from i to j

  PGCCD_HD void store(const ContactsOnPaths& given, int64_t row, Surfaces& surfaces) const {
    Vec3<double> found = given.normal_of(row);
    if (given.contacts.kind[row] <= kKindEE && given.exists(row)) found = surfaces.normal(given.site(row), found);
    store_vec3(normal + 3 * row, found);
  }
};

struct CertainRecession {
  const int8_t* status;  // (contacts,)
  const double* slack;   // (bodies,) the smaller one of a pair counts
  uint8_t* certain;      // (contacts,)

  // Contacts that are unresolved do not certainly recede, nor those of surfaces that intersect.
  PGCCD_HD void store(const ContactsOnPaths& given, int64_t row, Surfaces& surfaces) const {
    constexpr int kTouch = 1;
    certain[row] = 0;
    if (status[row] != kTouch || given.contacts.kind[row] > kKindEE || !given.exists(row)) return;
    const Site site = given.site(row);
    Recession recession(site, given.normal_of(row), smaller(slack[site.body[0]], slack[site.body[1]]));
    certain[row] = recession.is_certain(surfaces) ? 1 : 0;
  }
};

void surface_normals(const Executor& executor, const ContactsOnPaths& given, const SurfaceNormals& out);
void surface_normals(const DeviceContext& context, const ContactsOnPaths& given, const SurfaceNormals& out);
void certainly_recede(const Executor& executor, const ContactsOnPaths& given, const CertainRecession& out);
void certainly_recede(const DeviceContext& context, const ContactsOnPaths& given, const CertainRecession& out);

}  // namespace pgccd
