// Narrow phase: candidates in, contacts out.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "kernels/executor.h"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/elementary_item.h"

namespace pgccd {

enum class Report : int32_t {
  kAny = 0,    // which pairs touch; features and toi are those of an arbitrary contact
  kFirst = 1,  // earliest contact of each pair
  kAll = 2,    // every touching feature pair
};

struct NarrowInput {
  CandidateSpan candidates;
  const int64_t* pairs;  // (pair_count, 2) body indices
  int64_t pair_count;
  NarrowSettings settings;
  Report report;
  const double* latest = nullptr;  // (pair_count,) or null: later contacts may be skipped; used only on the CPU
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
  double* first;
};

// Rows in canonical order: by pair, then kind and features (kAll), or one row per pair (kAny, kFirst).
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

// Copies the first `count` rows, except bodies.
void copy_rows(const ContactRows& rows, int64_t count, const ContactColumns& out);

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

template <class Bodies>
ContactRows narrow_phase_cpu(const Executor& executor, const Bodies& bodies, const NarrowInput& input);

// Elementary tests on straight paths. points_*: (count, 4, 3). kEdgeEdge false: vertex, three face points; true: edge,
// edge.
template <bool kEdgeEdge, class T>
void elementary_cpu(const Executor& executor, const T* points_t0, const T* points_t1, int64_t count,
                    const NarrowSettings& settings, const ElementaryColumns<T>& out);

}  // namespace pgccd
