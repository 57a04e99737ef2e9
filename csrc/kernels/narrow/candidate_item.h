// One candidate: from body poses to its outcome, and from the outcome to the contact's point and normal.
#pragma once

#include <type_traits>

#include "kernels/narrow/pair_points.h"
#include "kernels/narrow/precision_ladder.h"
#include "kernels/narrow/winding_item.h"

namespace pgccd {

PGCCD_HD bool uses_arcs(const RigidBodies& bodies) { return !bodies.linear_path; }
PGCCD_HD bool uses_arcs(const DeformingBodies&) { return false; }

// True if a candidate has a valid pair (i, j) of `pairs` (pair_count, 2), kind, and features of the pair's bodies.
template <class Bodies>
PGCCD_HD bool names_features(const Bodies& bodies, const int64_t* pairs, int64_t pair_count,
                             const Candidate& candidate) {
  if (!is_within(candidate.pair, pair_count)) return false;
  const auto kind = static_cast<FeatureKind>(candidate.kind);
  if (candidate.kind < 0 || candidate.kind >= kFeatureKinds) return false;
  for (int side = 0; side < 2; ++side) {
    const int64_t body = pairs[2 * int64_t{candidate.pair} + side];
    if (!is_sound(bodies, body)) return false;
    const MeshOffsets* rows = bodies.meshes.offsets + bodies.mesh_index[body];
    const bool is_inside = kind == (side == 0 ? FeatureKind::kInside : FeatureKind::kContains);
    const bool is_vertex = is_inside || kind == (side == 0 ? FeatureKind::kVertexFace : FeatureKind::kFaceVertex);
    const bool is_edge =
        kind == FeatureKind::kEdgeEdge || kind == (side == 0 ? FeatureKind::kEdgeFace : FeatureKind::kFaceEdge);
    const int64_t edges_or_faces = is_edge ? rows[1].edge - rows[0].edge : rows[1].face - rows[0].face;
    const int64_t count = is_vertex ? rows[1].vertex - rows[0].vertex : edges_or_faces;
    if (!is_within(side == 0 ? candidate.feature_i : candidate.feature_j, count)) return false;
    if (is_inside && !is_solid(bodies.meshes, bodies.mesh_index[pairs[2 * int64_t{candidate.pair} + 1 - side]])) {
      return false;
    }
  }
  return true;
}

// Calls `use` with the path of the feature pair, in the precision of `pair`.
template <FeatureKind kKind, class Bodies, class Pair, class Use>
PGCCD_HD auto with_path(const Bodies& bodies, const Pair& pair, const FeatureVertices& f, const Use& use) {
  if constexpr (std::is_same_v<Bodies, RigidBodies>) {
    if (uses_arcs(bodies)) return use(pair.template arc_path<kKind>(bodies, f));
  }
  using T = typename Pair::Number;
  Vec3<T> t0[4], t1[4];
  pair.template end_positions<kKind>(bodies, f, t0, t1);
  return use(LinearPath<kKind, T>(t0, t1, pair.point_error));
}

// What the status of a rigid pair's search in double amounts to: a touch, if the distance was within the tolerance; or
// undecided, if double-double removes most of the noise. It does not remove the errors of points that turn.
template <class Path>
PGCCD_HD Status settled(const RigidBodies& bodies, const RigidPair& pair, const Path& path,
                        const SearchSettings<double>& settings, Status status) {
  if (status != Status::kUndecided && status != Status::kUnresolved) return status;
  const double noise = distance_noise(path.error());
  const bool is_noise = noise > wanted_distance(path, settings);
  if (is_noise && noise > 16.0 * pair.turning_error(bodies) * path.scale()) return Status::kUndecided;
  return status == Status::kUndecided ? Status::kTouch : status;
}

// A search that `settled` leaves undecided. A separate function, so that its registers and stack are not part of the
// common phases.
template <FeatureKind kKind>
PGCCD_HD_RARE Outcome<double> solve_finely(const RigidBodies& bodies, const RigidPair& pair, const FeatureVertices& f,
                                           const SearchSettings<double>& settings, double begin) {
  const RigidPairIn<DoubleDouble> fine(bodies, pair.body[0], pair.body[1]);
  return with_path<kKind>(bodies, fine, f,
                          [&](const auto& path) { return continue_finely<kKind>(path, settings, begin); });
}

// `progress`: initial, or as left by the quick phase.
template <FeatureKind kKind, class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_features(const Bodies& bodies, const Pair& pair, const FeatureVertices& f,
                                        const SearchSettings<double>& settings, Progress<double> progress) {
  if constexpr (std::is_same_v<Bodies, RigidBodies>) {
    const Outcome<double> outcome = with_path<kKind>(bodies, pair, f, [&](const auto& path) {
      Outcome<double> found = advance_to_contact<kKind>(path, settings, progress);
      found.status = settled(bodies, pair, path, settings, found.status);
      return found;
    });
    if (outcome.status != Status::kUndecided) return outcome;
    return solve_finely<kKind>(bodies, pair, f, settings, outcome.toi);
  } else {
    Vec3<double> t0[4], t1[4];
    pair.template end_positions<kKind>(bodies, f, t0, t1);
    return solve_straight<kKind>(t0, t1, settings).outcome;
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
  return with_kind(candidate, [&]<FeatureKind kKind>(KindConstant<kKind>) {
    return with_path<kKind>(bodies, pair, f,
                            [&](const auto& path) { return is_quickly_free<kKind>(path, search, progress); });
  });
}

template <FeatureKind kKind, class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_features_plainly(const Bodies& bodies, const Pair& pair, const FeatureVertices& f,
                                                const SearchSettings<double>& settings, Progress<double> progress) {
  return with_path<kKind>(bodies, pair, f, [&](const auto& path) {
    Outcome<double> found = advance_in_phase<kKind, Phase::kPlain>(path, settings, progress);
    if constexpr (std::is_same_v<Bodies, RigidBodies>) {
      found.status = settled(bodies, pair, path, settings, found.status);
      if (found.status == Status::kUndecided) found.status = Status::kOpen;
    }
    return found;
  });
}

// The outcome of `solve_candidate` if the plain phase finds it, else kOpen.
template <class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_plainly(const Bodies& bodies, const Pair& pair, const Candidate& candidate,
                                       const NarrowSettings& settings, double latest, Progress<double> progress) {
  const SearchSettings<double> search = search_settings(bodies, pair, settings, latest);
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  return with_kind(candidate, [&]<FeatureKind kKind>(KindConstant<kKind>) {
    return solve_features_plainly<kKind>(bodies, pair, f, search, progress);
  });
}

template <class Bodies, class Pair>
PGCCD_HD Outcome<double> solve_candidate(const Bodies& bodies, const Pair& pair, const Candidate& candidate,
                                         const NarrowSettings& settings, double latest,
                                         Progress<double> progress = {}) {
  const SearchSettings<double> search = search_settings(bodies, pair, settings, latest);
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  return with_kind(candidate, [&]<FeatureKind kKind>(KindConstant<kKind>) {
    return solve_features<kKind>(bodies, pair, f, search, progress);
  });
}

// As `passes_through`, for a candidate of that kind. `fine()`: the pair with points in higher precision.
template <class Bodies, class Pair, class Fine>
PGCCD_HD_RARE Crossing crossing_of(const Bodies& bodies, const Pair& pair, const Fine& fine, const Candidate& candidate,
                                   bool exactly) {
  const CrossingVertices c = crossing_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  const auto points = [&] { return in_double_double(fine().edge_and_face(bodies, c)); };
  return passes_through(pair.edge_and_face(bodies, c), pair.point_error, points, exactly);
}

PGCCD_HD Outcome<double> at_start(bool is_contact) {
  return is_contact ? Outcome<double>{Status::kTouch, 0.0, 0.0, 0.0}
                    : Outcome<double>{Status::kFree, static_cast<double>(INFINITY), 0.0, 0.0};
}

template <class Bodies, class Pair, class Fine>
PGCCD_HD Outcome<double> solve_crossing(const Bodies& bodies, const Pair& pair, const Fine& fine,
                                        const Candidate& candidate) {
  return at_start(crossing_of(bodies, pair, fine, candidate, true) == Crossing::kPasses);
}

template <class Bodies, class Pair, class Fine>
PGCCD_HD Outcome<double> solve_enclosure(const Bodies& bodies, const Pair& pair, const Fine& fine,
                                         const Candidate& candidate) {
  const bool is_of_i = candidate.kind == static_cast<int32_t>(FeatureKind::kInside);
  const int32_t vertex = is_of_i ? candidate.feature_i : candidate.feature_j;
  return at_start(winding_number(bodies, pair, fine, is_of_i ? 0 : 1, vertex) != 0);
}

// Of a candidate that the bodies at t = 0 decide.
template <class Bodies, class Pair, class Fine>
PGCCD_HD Outcome<double> solve_start(const Bodies& bodies, const Pair& pair, const Fine& fine,
                                     const Candidate& candidate) {
  return is_enclosure(candidate) ? solve_enclosure(bodies, pair, fine, candidate)
                                 : solve_crossing(bodies, pair, fine, candidate);
}

}  // namespace pgccd
