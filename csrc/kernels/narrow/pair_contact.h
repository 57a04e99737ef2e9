// A contact of a pair of bodies, without its place.
#pragma once

#include "core/candidate.h"
#include "kernels/narrow/search_state.h"

namespace pgccd {

struct PairContact {
  Candidate candidate{};
  Outcome<double> outcome{Status::kFree, static_cast<double>(INFINITY), 0.0, 0.0};

  PGCCD_HD bool is_found() const { return outcome.status != Status::kFree; }

  // As for rows of contacts: the first one, of equal toi that of the smallest features.
  PGCCD_HD bool is_before(const PairContact& other) const {
    if (outcome.toi != other.outcome.toi) return outcome.toi < other.outcome.toi;
    const Candidate &c = candidate, &d = other.candidate;
    if (c.kind != d.kind) return c.kind < d.kind;
    return c.feature_i != d.feature_i ? c.feature_i < d.feature_i : c.feature_j < d.feature_j;
  }
};

}  // namespace pgccd
