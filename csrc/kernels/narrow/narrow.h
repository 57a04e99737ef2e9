// Narrow phase: candidates in, contacts out.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/elementary_item.h"
#include "kernels/narrow/pair_contact.h"

namespace pgccd {

// Names in the same order: pgccd/search/narrow.py.
enum class Report : int32_t {
  kAny = 0,       // which pairs touch; features and toi are those of an arbitrary contact
  kFirst = 1,     // earliest contact of each pair
  kAll = 2,       // every touching feature pair
  kEarliest = 3,  // as kFirst, but contacts later than the earliest of the scene may be left out
};
constexpr int64_t kReports = 4;

// Whether one contact of a pair is wanted, the first one.
PGCCD_HD bool wants_first(Report report) { return report == Report::kFirst || report == Report::kEarliest; }

struct NarrowInput {
  CandidateSpan candidates;
  const int64_t* pairs;  // (pair_count, 2) body indices
  int64_t pair_count;
  NarrowSettings settings;
  Report report;
  const double* latest = nullptr;  // (pair_count,) or null: later contacts may be skipped; used only on the CPU
  bool may_have_starts = true;     // false: the bodies at t = 0 decide no candidate; used only on devices
};

// Capacity of a narrow phase that does not synchronise.
struct ContactCapacity {
  int64_t open;      // candidates left by the quick phase
  int64_t contacts;  // rows
};

constexpr int64_t kExactly = -1;  // as many rows as contacts: only on the CPU, where the count is known

// Its counts; the number of rows may be too small if the open candidates, or an earlier stage, overflowed.
enum ContactCount : int {
  kOpenNeeded,
  kContactsNeeded,
  kUnresolvedWritten,
  kContactsOverflow,  // 1 if the capacity was exceeded, else 0
  kNarrowEnded,
  kContactCounts
};

// Output of first toi only: the two owners of each pair, and their first toi so far.
struct FirstToi {
  const int64_t* owners;  // (pair_count, 2) indices into `first`
  double* first;          // (count,)
  int64_t count;
};

// Memory for contact rows; columns as in ContactRows.
struct ContactColumns {
  int32_t* pair;    // either this or `bodies` may be null
  int64_t* bodies;  // (rows, 2)
  int8_t* kind;
  int32_t* features;
  int8_t* status;
  double* toi;
  double* coordinates;
  double* point;
  double* normal;
};

// Called once with the number of rows.
using ContactOutput = std::function<ContactColumns(int64_t count)>;

// Throws an error if a candidate names a pair, kind or features that are not there. A device synchronises to read that,
// and the number of contacts.
template <class Bodies>
void narrow_phase(const Executor& executor, const Bodies& bodies, const NarrowInput& input,
                  const ContactOutput& make_output);
template <class Bodies>
void narrow_phase(const DeviceContext& context, const Bodies& bodies, const NarrowInput& input,
                  const ContactOutput& make_output);

// Elementary tests on straight paths. points_*: (count, 4, 3). kVertexFace: vertex, three face points; kEdgeEdge: two
// edges.
template <FeatureKind kKind, class T>
void elementary(const Executor& executor, const T* points_t0, const T* points_t1, int64_t count,
                const NarrowSettings& settings, const ElementaryColumns<T>& out);
template <FeatureKind kKind, class T>
void elementary(const DeviceContext& context, const T* points_t0, const T* points_t1, int64_t count,
                const NarrowSettings& settings, const ElementaryColumns<T>& out);

// Rows in canonical order: by pair, then kind and features (kAll), or one row per pair.
struct ContactRows {
  std::vector<int32_t> pair;  // index into `pairs`
  std::vector<int8_t> kind;
  std::vector<int32_t> features;  // (rows, 2)
  std::vector<int8_t> status;
  std::vector<double> toi;
  std::vector<double> coordinates;  // (rows, 2)
  std::vector<double> point;        // (rows, 3)
  std::vector<double> normal;       // (rows, 3)
};

// Copies the first `count` rows, except bodies.
void copy_contacts(const ContactRows& rows, int64_t count, const ContactColumns& out);

// The contacts of candidates, which are all sound.
template <class Bodies>
ContactRows solve_candidates(const Executor& executor, const Bodies& bodies, const NarrowInput& input);

// The contact to report of candidates of a single pair, input.pairs, which are all sound: on the calling thread.
template <class Bodies>
PairContact contact_of_pair(const Bodies& bodies, const NarrowInput& input);

// The first contact of each pair, of two lists by pair with one row each; without those of `one` after a time of its
// pair.
ContactRows first_of_each_pair(const ContactRows& one, const ContactRows& other, const std::vector<double>& latest);

void append_rows(ContactRows& rows, const ContactRows& more);
// The rows until a time, sorted by pair.
ContactRows by_pair_until(const ContactRows& rows, double latest);

// Stores a padding row, after the last contact.
PGCCD_HD void pad_row(const ContactColumns& out, int64_t row) {
  if (out.pair != nullptr) out.pair[row] = -1;
  if (out.bodies != nullptr) out.bodies[2 * row] = out.bodies[2 * row + 1] = -1;
  out.kind[row] = 0;
  out.features[2 * row] = out.features[2 * row + 1] = -1;
  out.status[row] = static_cast<int8_t>(Status::kFree);
  out.toi[row] = static_cast<double>(INFINITY);
  out.coordinates[2 * row] = out.coordinates[2 * row + 1] = 0.0;
  for (int k = 0; k < 3; ++k) out.point[3 * row + k] = out.normal[3 * row + k] = 0.0;
}

// A narrow phase on a device that does not synchronise, of candidates that come in one or two parts; see search.cuh.
// `most_open`: capacity for candidates left by the quick phase. Without contacts, only the first toi of each pair is
// found.
struct Search;
Search new_search(const DeviceContext& context, const NarrowInput& input, int64_t most_open, bool with_contacts);

template <class Bodies>
void search_candidates(const DeviceContext& context, const Bodies& bodies, Search& search,
                       const CandidateSpan& candidates, bool is_last);

// What the first part found; with the smallest features of contacts at t = 0, if they help.
FirstPart first_part_of(const DeviceContext& context, const Search& search, bool with_features);

// Unused rows of `out` are filled: pair and features -1, toi infinite, the rest 0.
template <class Bodies>
void write_contacts(const DeviceContext& context, const Bodies& bodies, const Search& search, int64_t most,
                    const ContactColumns& out, int64_t* counts);

// Lowers the first toi of the owners of each pair. kContactsNeeded counts pairs with a contact; unresolved ones are not
// counted separately.
void write_first_toi(const DeviceContext& context, const Search& search, const FirstToi& known, int64_t* counts);

}  // namespace pgccd
