// Where two features touch: parameters, point and normal. They follow from the toi alone, so they depend neither on the
// phase of the search that found it nor on that phase's precision.
#pragma once

#include <type_traits>

#include "kernels/narrow/candidate_item.h"

namespace pgccd {

struct ContactPlace {
  double u, v;          // of the nearest points at toi, see Nearest
  Vec3<double> point;   // world, halfway between the nearest points at toi
  Vec3<double> normal;  // unit, from body i towards body j
};

// Writes a row of contacts, except for its pair. columns: ContactRows or ContactColumns; found: status and toi.
template <class Columns, class Found>
PGCCD_HD void store_contact(Columns& columns, int64_t row, const Candidate& candidate, const Found& found,
                            const ContactPlace& place) {
  // One kind for solids of either side: that of the vertex has a feature, the other -1.
  const int32_t inside = static_cast<int32_t>(FeatureKind::kInside);
  columns.kind[row] = static_cast<int8_t>(smaller(candidate.kind, inside));
  columns.features[2 * row] = candidate.kind > inside ? -1 : candidate.feature_i;
  columns.features[2 * row + 1] = candidate.kind == inside ? -1 : candidate.feature_j;
  columns.status[row] = static_cast<int8_t>(found.status);
  columns.toi[row] = found.toi;
  columns.coordinates[2 * row] = place.u;
  columns.coordinates[2 * row + 1] = place.v;
  store_vec3(&columns.point[3 * row], place.point);
  store_vec3(&columns.normal[3 * row], place.normal);
}

namespace contact_detail {

PGCCD_HD Vec3<double> unit_or_zero(Vec3<double> v) {
  const double length = norm(v);
  return length > 0.0 ? (1.0 / length) * v : Vec3<double>{0.0, 0.0, 0.0};
}
// The features at a time. On straight paths the differences themselves are interpolated, so that they are accurate
// however far the points are from the world's origin.
template <FeatureKind kKind>
struct Features {
  Vec3<double> x[4];
  FeaturePair<double> pair;  // times a power of two
};

template <FeatureKind kKind, class Bodies, class Pair>
PGCCD_HD Features<kKind> features_at(const Bodies& bodies, const Pair& pair, const FeatureVertices& f, double t) {
  Features<kKind> out;
  Vec3<double>(&x)[4] = out.x;
  if constexpr (std::is_same_v<Bodies, RigidBodies>) {
    if (uses_arcs(bodies)) {
      pair.template arc_path<kKind>(bodies, f).positions(t, x);
      out.pair = feature_pair<kKind>(x[0], x[1], x[2], x[3]);
      return out;
    }
  }
  Vec3<double> t0[4], t1[4];
  pair.template end_positions<kKind>(bodies, f, t0, t1);
  for (int k = 0; k < 4; ++k) x[k] = (1.0 - t) * t0[k] + t * t1[k];
  out.pair = LinearPath<kKind, double>(t0, t1, 0.0).at(t);
  return out;
}

// Origin of the coordinates of `features_at`.
PGCCD_HD Vec3<double> frame_origin(const RigidBodies& bodies, const RigidPair& pair, bool swapped, double t) {
  const int64_t body = pair.body[swapped ? 1 : 0];
  return (1.0 - t) * load_vec3(bodies.centres.position_t0 + 3 * body) +
         t * load_vec3(bodies.centres.position_t1 + 3 * body);
}
PGCCD_HD Vec3<double> frame_origin(const DeformingBodies&, const DeformingPair&, bool, double) {
  return {0.0, 0.0, 0.0};
}

// Offset between the SBV centres.
PGCCD_HD Vec3<double> centre_offset(const RigidBodies& bodies, const RigidPair& pair, double t) {
  Vec3<double> offset = (1.0 - t) * pair.centre.at_t0 + t * pair.centre.at_t1;
  for (int side = 0; side < 2; ++side) {
    const Vec3<double> centre = mesh_centre(bodies, pair.body[side]);
    if (is_centred(centre)) continue;
    const Spin& spin = pair.spin[side];
    const Vec3<double> start = pair.orientation[side] * centre;
    const Vec3<double> now = uses_arcs(bodies) ? rotate(spin, sine_cosine(spin.angle * t), start)
                                               : (1.0 - t) * start + t * rotate(spin, sine_cosine(spin.angle), start);
    offset = side == 0 ? offset - now : offset + now;
  }
  return offset;
}
PGCCD_HD Vec3<double> centre_offset(const DeformingBodies& bodies, const DeformingPair& pair, double t) {
  const RelativeCentre centre = relative_centre(bodies.centres, pair.body[0], pair.body[1]);
  return (1.0 - t) * centre.at_t0 + t * centre.at_t1;
}

template <FeatureKind kKind, class Bodies, class Pair>
PGCCD_HD ContactPlace place(const Bodies& bodies, const Pair& pair, const FeatureVertices& f, double toi) {
  const Features<kKind> features = features_at<kKind>(bodies, pair, f, toi);
  const Nearest<double> nearest = nearest_points<kKind>(features.pair);
  const double u = nearest.u, v = nearest.v;
  const auto& x = features.x;
  const Vec3<double> on_first = kIsEdgeEdge<kKind> ? x[0] + u * (x[1] - x[0]) : x[0];
  const Vec3<double> on_second =
      kIsEdgeEdge<kKind> ? x[2] + v * (x[3] - x[2]) : x[1] + (u * (x[2] - x[1]) + v * (x[3] - x[1]));
  const Vec3<double> middle = frame_origin(bodies, pair, f.swapped, toi) + 0.5 * (on_first + on_second);

  // The gap gives the normal unless it is below rounding; then the features' own normal does, oriented from centre to
  // centre.
  Vec3<double> normal = nearest.offset;
  if (!(norm(normal) > 0x1p-40 * extent(features.pair))) {
    normal = cross(features.pair.a, features.pair.b);
    const double along = dot(normal, centre_offset(bodies, pair, toi));
    if ((along < 0.0) != f.swapped) normal = -normal;
  }
  if (f.swapped) normal = -normal;
  return {u, v, middle, unit_or_zero(normal)};
}

// Where an edge passes through a face at t = 0. The normal is the face's: of two bodies, oriented from centre to
// centre.
template <class Bodies, class Pair>
PGCCD_HD_RARE ContactPlace place_crossing(const Bodies& bodies, const Pair& pair, const CrossingVertices& c) {
  const EdgeAndFace<double> x = pair.edge_and_face(bodies, c);
  const FacePoint at = crossing_point(in_double_double(pair.fine(bodies).edge_and_face(bodies, c)), size_of(x));
  const Vec3<double> corner = x.point[2], a = x.point[3] - corner, b = x.point[4] - corner;
  const Vec3<double> point = frame_origin(bodies, pair, c.swapped, 0.0) + (corner + (at.u * a + at.v * b));
  Vec3<double> normal = cross(a, b);
  if (dot(normal, centre_offset(bodies, pair, 0.0)) < 0.0) normal = -normal;
  return {at.u, at.v, point, unit_or_zero(normal)};
}

// A vertex inside of a solid at t = 0: no direction leads out of it.
template <class Bodies, class Pair>
PGCCD_HD ContactPlace place_enclosure(const Bodies& bodies, const Pair& pair, const Candidate& candidate) {
  const bool is_of_i = candidate.kind == static_cast<int32_t>(FeatureKind::kInside);
  const int64_t vertex = is_of_i ? candidate.feature_i : candidate.feature_j;
  const Vec3<double> offset = pair.edge_and_face(bodies, {{vertex, vertex}, {0, 0, 0}, !is_of_i}).point[0];
  const auto nan = static_cast<double>(NAN);
  return {0.0, 0.0, frame_origin(bodies, pair, !is_of_i, 0.0) + offset, {nan, nan, nan}};
}

}  // namespace contact_detail

template <class Bodies, class Pair>
PGCCD_HD ContactPlace contact_place(const Bodies& bodies, const Pair& pair, const Candidate& candidate, double toi) {
  if (is_enclosure(candidate)) return contact_detail::place_enclosure(bodies, pair, candidate);
  if (is_crossing(candidate)) {
    return contact_detail::place_crossing(bodies, pair,
                                          crossing_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate));
  }
  const FeatureVertices f = feature_vertices(bodies.meshes, pair.mesh[0], pair.mesh[1], candidate);
  return with_kind(candidate, [&]<FeatureKind kKind>(KindConstant<kKind>) {
    return contact_detail::place<kKind>(bodies, pair, f, toi);
  });
}

}  // namespace pgccd
