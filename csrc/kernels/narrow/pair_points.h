// The points of a candidate's features, from body poses or vertex streams.
#pragma once

#include <type_traits>

#include "core/candidate.h"
#include "core/centre_arc.h"
#include "kernels/narrow/crossing.h"
#include "kernels/narrow/paths.h"

namespace pgccd {

// The mesh points x0 .. x3 of a candidate, and whether the first primitive belongs to body i or j.
struct FeatureVertices {
  int64_t vertex[4];  // indices within their meshes
  bool swapped;       // first primitive belongs to body j
};

PGCCD_HD FeatureVertices feature_vertices(const MeshSetView& meshes, int32_t mesh_i, int32_t mesh_j,
                                          const Candidate& c) {
  const MeshOffsets& oi = meshes.offsets[mesh_i];
  const MeshOffsets& oj = meshes.offsets[mesh_j];
  if (c.kind == static_cast<int32_t>(FeatureKind::kEdgeEdge)) {
    const int32_t* ei = meshes.edges + 2 * (oi.edge + c.feature_i);
    const int32_t* ej = meshes.edges + 2 * (oj.edge + c.feature_j);
    return {{ei[0], ei[1], ej[0], ej[1]}, false};
  }
  if (c.kind == static_cast<int32_t>(FeatureKind::kVertexFace)) {
    const int32_t* f = meshes.faces + 3 * (oj.face + c.feature_j);
    return {{c.feature_i, f[0], f[1], f[2]}, false};
  }
  const int32_t* f = meshes.faces + 3 * (oi.face + c.feature_i);
  return {{c.feature_j, f[0], f[1], f[2]}, true};
}

// The edge and the face of a candidate for t = 0.
struct CrossingVertices {
  int64_t edge[2], face[3];  // indices within their meshes
  bool swapped;              // the edge belongs to body j
};

PGCCD_HD CrossingVertices crossing_vertices(const MeshSetView& meshes, int32_t mesh_i, int32_t mesh_j,
                                            const Candidate& c) {
  const bool swapped = c.kind == static_cast<int32_t>(FeatureKind::kFaceEdge);
  const MeshOffsets& of_edge = meshes.offsets[swapped ? mesh_j : mesh_i];
  const MeshOffsets& of_face = meshes.offsets[swapped ? mesh_i : mesh_j];
  const int32_t* e = meshes.edges + 2 * (of_edge.edge + (swapped ? c.feature_j : c.feature_i));
  const int32_t* f = meshes.faces + 3 * (of_face.face + (swapped ? c.feature_i : c.feature_j));
  return {{e[0], e[1]}, {f[0], f[1], f[2]}, swapped};
}

// Error of the centre offset, and of adding it to a point.
template <class T>
PGCCD_HD T centre_error(const RelativeCentreIn<T>& centre) {
  return T(8) * T(Precision<T>::unit) * larger(max_abs(centre.at_t0), max_abs(centre.at_t1));
}

// Values shared by all candidates of a body pair. Points are computed in T, except for rotations during the step.
template <class T>
struct RigidPairIn {
  using Number = T;
  int64_t body[2];
  int32_t mesh[2];
  Mat3<T> orientation[2];
  Spin spin[2];
  RelativeCentreIn<T> centre;  // offset of body j's origin from body i's
  T point_error;

  PGCCD_HD RigidPairIn(const RigidBodies& bodies, int64_t i, int64_t j)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]}, centre(relative_centre<T>(bodies.centres, i, j)) {
    for (int side = 0; side < 2; ++side) {
      orientation[side] = rotation_matrix<T>(load_quaternion(bodies.orientation + 4 * body[side]));
      spin[side] = make_spin(load_vec3(bodies.rotation + 3 * body[side]));
    }
    point_error = centre_error(centre);
    for (int side = 0; side < 2; ++side) point_error = point_error + T(offset_error(bodies, side));
  }

  PGCCD_HD bool turns(int side) const { return spin[side].angle > 0.0; }

  // Error bound of computed offsets from a body's origin.
  PGCCD_HD double offset_error(const RigidBodies& bodies, int side) const {
    // The angle at a time has a relative rounding error, which moves a point in proportion to the angle.
    const double units = kRigidPointUnits + 8.0 * spin[side].angle;
    const double unit = turns(side) ? Precision<double>::unit : Precision<T>::unit;
    return units * unit * mesh_reach(bodies, body[side]);
  }

  // The part of the points' error that remains in higher precision.
  PGCCD_HD double turning_error(const RigidBodies& bodies) const {
    return (turns(0) ? offset_error(bodies, 0) : 0.0) + (turns(1) ? offset_error(bodies, 1) : 0.0);
  }

  template <FeatureKind kKind>
  PGCCD_HD void bases(const RigidBodies& bodies, const FeatureVertices& f, Vec3<T> base[4]) const {
    for (int k = 0; k < 4; ++k) {
      const int side = side_of<kKind>(f, k);
      const int64_t row = bodies.meshes.offsets[mesh[side]].vertex + f.vertex[k];
      base[k] = orientation[side] * cast<T>(load_vec3(bodies.meshes.vertices + 3 * row));
    }
  }

  template <FeatureKind kKind>
  PGCCD_HD static int side_of(const FeatureVertices& f, int k) {
    return (k < PointSplit<kKind>::first_count) == f.swapped ? 1 : 0;
  }

  // Offset of the second primitive's body from the first primitive's.
  PGCCD_HD RelativeCentreIn<T> named_centre(const FeatureVertices& f) const {
    if (!f.swapped) return centre;
    return {-centre.at_t0, -centre.at_t1};
  }

  template <FeatureKind kKind>
  PGCCD_HD ArcPath<kKind, T> arc_path(const RigidBodies& bodies, const FeatureVertices& f) const {
    Vec3<T> base[4];
    bases<kKind>(bodies, f, base);
    const int first = f.swapped ? 1 : 0, second = 1 - first;
    return {base, spin[first], spin[second], named_centre(f), point_error};
  }

  // At t = 0, relative to the origin of the edge's body: by the same products and shift as `end_positions`.
  PGCCD_HD EdgeAndFace<T> edge_and_face(const RigidBodies& bodies, const CrossingVertices& c) const {
    const int of_edge = c.swapped ? 1 : 0, of_face = 1 - of_edge;
    const Vec3<T> shift = c.swapped ? -centre.at_t0 : centre.at_t0;
    const auto turned = [&](int side, int64_t vertex) {
      const int64_t row = bodies.meshes.offsets[mesh[side]].vertex + vertex;
      return orientation[side] * cast<T>(load_vec3(bodies.meshes.vertices + 3 * row));
    };
    EdgeAndFace<T> x;
    for (int k = 0; k < 2; ++k) x.point[k] = turned(of_edge, c.edge[k]);
    for (int k = 0; k < 3; ++k) x.point[2 + k] = shift + turned(of_face, c.face[k]);
    return x;
  }
  using Fine = RigidPairIn<DoubleDouble>;
  PGCCD_HD Fine fine(const RigidBodies& bodies) const { return {bodies, body[0], body[1]}; }

  // End positions relative to the origin of the first primitive's body.
  template <FeatureKind kKind>
  PGCCD_HD void end_positions(const RigidBodies& bodies, const FeatureVertices& f, Vec3<T> t0[4], Vec3<T> t1[4]) const {
    bases<kKind>(bodies, f, t0);
    const RelativeCentreIn<T> shift = named_centre(f);
    for (int k = 0; k < 4; ++k) {
      const Spin& s = spin[side_of<kKind>(f, k)];
      t1[k] = rotate(s, sine_cosine(s.angle), t0[k]);
      if (k >= PointSplit<kKind>::first_count) {
        t0[k] = shift.at_t0 + t0[k];
        t1[k] = shift.at_t1 + t1[k];
      }
    }
  }
};

using RigidPair = RigidPairIn<double>;

struct DeformingPair {
  using Number = double;
  static constexpr double point_error = 0.0;  // the given vertices are exact
  int64_t body[2];
  int32_t mesh[2];

  PGCCD_HD DeformingPair(const DeformingBodies& bodies, int64_t i, int64_t j)
      : body{i, j}, mesh{bodies.mesh_index[i], bodies.mesh_index[j]} {}

  // At t = 0, world coordinates.
  PGCCD_HD EdgeAndFace<double> edge_and_face(const DeformingBodies& bodies, const CrossingVertices& c) const {
    const int of_edge = c.swapped ? 1 : 0, of_face = 1 - of_edge;
    const auto vertex = [&](int side, int64_t index) {
      return load_vec3(bodies.vertices_t0 + 3 * (bodies.vertex_begin[body[side]] + index));
    };
    return {{vertex(of_edge, c.edge[0]), vertex(of_edge, c.edge[1]), vertex(of_face, c.face[0]),
             vertex(of_face, c.face[1]), vertex(of_face, c.face[2])}};
  }
  using Fine = DeformingPair;
  PGCCD_HD const Fine& fine(const DeformingBodies&) const { return *this; }

  // World coordinates: only their differences are used, so no shift is needed.
  template <FeatureKind kKind>
  PGCCD_HD void end_positions(const DeformingBodies& bodies, const FeatureVertices& f, Vec3<double> t0[4],
                              Vec3<double> t1[4]) const {
    for (int k = 0; k < 4; ++k) {
      const int side = (k < PointSplit<kKind>::first_count) == f.swapped ? 1 : 0;
      const int64_t row = bodies.vertex_begin[body[side]] + f.vertex[k];
      t0[k] = load_vec3(bodies.vertices_t0 + 3 * row);
      t1[k] = load_vec3(bodies.vertices_t1 + 3 * row);
    }
  }
};

template <class Bodies>
using PairOf = std::conditional_t<std::is_same_v<Bodies, RigidBodies>, RigidPair, DeformingPair>;

}  // namespace pgccd
