// What a search for the first contact of a candidate is given, how far it has come, and how it ended.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Values of the `status` tensor.
enum class Status : int8_t {
  kFree = 0,
  kTouch = 1,
  kUnresolved = 2,  // iteration budget spent: counts as a contact
  kPruned = 3,      // certainly later than the limit given; never leaves the kernels
  kUndecided = 4,   // within tolerance, but this arithmetic cannot tell a touch from a miss; never leaves the kernels
  kOpen = 5,        // a later phase has to go on; never leaves the kernels
};

template <class T>
struct SearchSettings {
  T separation;
  T tolerance;       // a contact comes at least this close, beyond the separation
  T prune_at;        // give up (kPruned) once free until this time
  bool nonzero_toi;  // shrink the tolerance rather than answer toi = 0 for a pair that starts further apart than the
                     // separation
};

template <class T>
struct Outcome {
  Status status;
  T toi;  // free before it
  T u, v;
};

// How far a search has come: enough to go on as if it had never stopped.
template <class T>
struct Progress {
  T t = T(0);      // free before it
  T goal = T(-1);  // how near is near enough; negative where that is still to be decided
  int advances = 0;
};

}  // namespace pgccd
