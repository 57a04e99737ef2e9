// One candidate: from body poses to its outcome, and from the outcome to the contact's point and normal.
#pragma once

#include <type_traits>

#include "kernels/narrow/pair_points.h"
#include "kernels/narrow/precision_ladder.h"

namespace pgccd {

PGCCD_HD bool uses_arcs(const RigidBodies& bodies) { return !bodies.linear_path; }
PGCCD_HD bool uses_arcs(const DeformingBodies&) { return false; }

// Calls `use` with the path of the feature pair, in double precision.
template <bool kEdgeEdge, class Bodies, class Pair, class Use>
PGCCD_HD auto with_path(const Bodies& bodies, const Pair& pair, const FeatureVertices& f, const Use& use) {
  if constexpr (std::is_same_v<Bodies, RigidBodies>) {
    if (uses_arcs(bodies)) return use(pair.template arc_path<kEdgeEdge>(bodies, f));
  }
  Vec3<double> t0[4], t1[4];
  pair.template end_positions<kEdgeEdge>(bodies, f, t0, t1);
  return use(LinearPath<kEdgeEdge, double>(t0, t1, pair.point_error));
}

// `progress`: initial, or as left by the quick phase.
template <bool kEdgeEdge, class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_features(const Bodies& bodies, const Pair& pair, const FeatureVertices& f,
                                        const SearchSettings<double>& settings, Progress<double> progress) {
  if constexpr (std::is_same_v<Bodies, RigidBodies>) {
    Outcome<double> outcome = with_path<kEdgeEdge>(
        bodies, pair, f, [&](const auto& path) { return advance_to_contact<kEdgeEdge>(path, settings, progress); });
    // Higher precision would not remove rounding errors of the points themselves.
    if (outcome.status == Status::kUndecided) outcome.status = Status::kTouch;
    return outcome;
  } else {
    Vec3<double> t0[4], t1[4];
    pair.template end_positions<kEdgeEdge>(bodies, f, t0, t1);
    return solve_straight<kEdgeEdge>(t0, t1, settings).outcome;
  }
}

// A candidate is dropped only if the toi that it would report, a double, is later than `latest`. Higher precision
// rounds its toi down to a double: before the next double, that toi could still be equal to `latest`, and among equal
// ones the smallest features win.
PGCCD_HD double prune_time(double latest) { return std::nextafter(latest, static_cast<double>(INFINITY)); }

template <class Bodies, class Pair>
PGCCD_HD SearchSettings<double> search_settings(const Bodies& bodies, const Pair& pair, const NarrowSettings& settings,
                                                double latest) {
  const double tolerance = pair_tolerance(bodies.centres, pair.body[0], pair.body[1], settings.tolerance);
  const double separation = pair_separation(bodies.centres, pair.body[0], pair.body[1], settings.separation);
  return {separation, tolerance, prune_time(latest), settings.nonzero_toi};
}

// True if the quick phase certifies that the candidate is free, or touches later than `latest`.
template <class Bodies, class Pair>
PGCCD_HD bool is_quickly_free(const Bodies& bodies, const Pair& pair, const Candidate& candidate,
                              const NarrowSettings& settings, double latest, Progress<double>& progress) {
  const SearchSettings<double> search = search_settings(bodies, pair, settings, latest);
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  if (candidate.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge)) {
    return with_path<true>(bodies, pair, f,
                           [&](const auto& path) { return is_quickly_free<true>(path, search, progress); });
  }
  return with_path<false>(bodies, pair, f,
                          [&](const auto& path) { return is_quickly_free<false>(path, search, progress); });
}

// The outcome of `solve_candidate` if the plain phase finds it, else kOpen.
template <class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_plainly(const Bodies& bodies, const Pair& pair, const Candidate& candidate,
                                       const NarrowSettings& settings, double latest, Progress<double> progress) {
  const SearchSettings<double> search = search_settings(bodies, pair, settings, latest);
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  if (candidate.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge)) {
    return with_path<true>(bodies, pair, f, [&](const auto& path) {
      return advance_in_phase<true, Phase::kPlain>(path, search, progress);
    });
  }
  return with_path<false>(bodies, pair, f, [&](const auto& path) {
    return advance_in_phase<false, Phase::kPlain>(path, search, progress);
  });
}

template <class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_candidate(const Bodies& bodies, const Pair& pair, const Candidate& candidate,
                                         const NarrowSettings& settings, double latest,
                                         Progress<double> progress = {}) {
  const SearchSettings<double> search = search_settings(bodies, pair, settings, latest);
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  if (candidate.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge)) {
    return solve_features<true>(bodies, pair, f, search, progress);
  }
  return solve_features<false>(bodies, pair, f, search, progress);
}

// As `passes_through`, for a candidate of that kind.
template <class Bodies, class Pair>
PGCCD_HD Crossing crossing_of(const Bodies& bodies, const Pair& pair, const Candidate& candidate, bool exactly) {
  const CrossingVertices c = crossing_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  return passes_through(pair.edge_and_face(bodies, c), exactly);
}

template <class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_crossing(const Bodies& bodies, const Pair& pair, const Candidate& candidate) {
  const CrossingVertices c = crossing_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  const EdgeAndFace x = pair.edge_and_face(bodies, c);
  if (passes_through(x, true) != Crossing::kPasses) return {Status::kFree, static_cast<double>(INFINITY), 0.0, 0.0};
  const FacePoint at = crossing_point(x);
  return {Status::kTouch, 0.0, at.u, at.v};
}

}  // namespace pgccd
