// Settings, progress and outcome of the search for the first contact of a candidate.
#pragma once

#include <cstdint>

#include "core/platform.h"

namespace pgccd {

// Values of the `status` tensor.
enum class Status : int8_t {
  kFree = 0,
  kTouch = 1,
  kUnresolved = 2,  // iteration budget spent: counts as a contact
  kPruned = 3,      // certainly later than the limit; internal
  kUndecided = 4,   // within tolerance or rounding, but undecided in this precision; internal
  kOpen = 5,        // a later phase must continue; internal
};

template <class T>
struct SearchSettings {
  T separation;
  T tolerance;       // a contact comes within separation + tolerance
  T prune_at;        // stop (kPruned) once free until this time
  bool nonzero_toi;  // reduce the tolerance rather than return toi = 0 for a pair that starts further apart than the
                     // separation
};

template <class T>
struct Outcome {
  Status status;
  T toi;  // free before it
  T u, v;
};

// Progress of a search, from which it can be continued.
template <class T>
struct Progress {
  T t = T(0);      // free before it
  T goal = T(-1);  // distance at which the search ends; negative: not chosen yet
  int advances = 0;
};

}  // namespace pgccd
