// One elementary query on straight paths; the points given are the truth.
#pragma once

#include "kernels/narrow/advancement.h"
#include "kernels/narrow/candidate_item.h"
#include "kernels/narrow/paths.h"

namespace pgccd {

template <bool kEdgeEdge>
PGCCD_HD Outcome<double> solve_elementary(const double* points_t0, const double* points_t1,
                                          const NarrowSettings& settings) {
  Vec3<double> t0[4], t1[4];
  for (int k = 0; k < 4; ++k) {
    t0[k] = load_vec3(points_t0 + 3 * k);
    t1[k] = load_vec3(points_t1 + 3 * k);
  }
  const SearchSettings<double> search{settings.separation, settings.tolerance, static_cast<double>(INFINITY),
                                      settings.nonzero_toi};
  return advance_to_contact<kEdgeEdge>(LinearPath<kEdgeEdge, double>(t0, t1, 0.0), search);
}

}  // namespace pgccd
