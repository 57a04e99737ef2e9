// A contact and its surroundings: the paths of its features' corners, and the faces and edges around its nearest
// points.
#pragma once

#include "core/bodies.h"

namespace pgccd {

// Values of `kind` of a contact, see pgccd/contacts/kinds.py.
constexpr int kKindEE = 2, kKindEFAB = 3, kKinds = 5;
// What a feature is, as columns of MeshOffsets.
enum Feature : int { kVertex = 0, kFace = 1, kEdge = 2 };

// Lists of rows: items[begin[k]] to items[begin[k + 1] - 1] are those of thing k.
struct RowLists {
  const int64_t* begin;
  const int64_t* items;
};

// Which faces and edges meet, in rows of all meshes.
struct Incidence {
  const int64_t* face_edges;  // (faces, 3): from the first corner to the second, and so on
  RowLists faces_of_vertex, edges_of_vertex, faces_of_edge;
  const double* outward;  // (meshes,) 1 if the corners' order gives normals out of a closed mesh, -1 into it, else 0
  int64_t most;           // faces, or edges, around a vertex or an edge
};

enum class PathKind { kArcs, kLines, kVertices };  // rigid; between the vertices of two poses; given by vertices

struct BodyPaths {
  MeshSetView meshes;
  const int32_t* mesh_index;  // (count,)
  int64_t count;
  PathKind kind;
  // (count, 3 or 4); null if given by vertices
  const double *position_t0, *position_t1, *orientation, *rotation;
  // (vertex_count, 3) world, and (count,) first row of each body; null otherwise
  const double *vertices_t0, *vertices_t1;
  const int64_t* vertex_begin;
  int64_t vertex_count;
};

struct ContactInput {
  const int64_t* bodies;      // (count, 2)
  const int8_t* kind;         // (count,)
  const int32_t* features;    // (count, 2)
  const double* coordinates;  // (count, 2)
  const double* toi;          // (count,)
  const double* point;        // (count, 3)
  int64_t count;
};

namespace contacts_detail {

// Coordinates of a point on the border of a feature may differ from 0 and 1 by so much, which is rounding.
constexpr double kBorder = 0x1p-46;
// Offsets below this part of the size of what was subtracted may be rounding.
constexpr double kNoise = 0x1p-36;

// Each product rounded: columns have had these bits since they were computed by torch.
PGCCD_HD double dot_of(Vec3<double> a, Vec3<double> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
PGCCD_HD double length_of(Vec3<double> a) { return std::sqrt(dot_of(a, a)); }
PGCCD_HD Vec3<double> unit_or_zero(Vec3<double> a) {
  const double length = length_of(a);
  return length > 0.0 ? Vec3<double>{a.x / length, a.y / length, a.z / length} : Vec3<double>{0.0, 0.0, 0.0};
}

// From body to world, by a unit quaternion.
PGCCD_HD Vec3<double> oriented(Vec3<double> v, Quaternion q) {
  const Vec3<double> twice = 2.0 * cross(q.v, v);
  return (v + q.w * twice) + cross(q.v, twice);
}

PGCCD_HD int feature_of(int kind, int side) {
  constexpr int8_t features[kKinds][2] = {
      {kVertex, kFace}, {kFace, kVertex}, {kEdge, kEdge}, {kEdge, kFace}, {kFace, kEdge}};
  return features[kind][side];
}

}  // namespace contacts_detail

// A feature, or what of a surface the nearest point lies on: kVertex, kFace or kEdge, and its row.
struct FeatureRow {
  int64_t what, row;
};

// Faces around a feature.
struct FacesAround {
  const int64_t* items;  // null for the face itself
  int64_t count, single;

  PGCCD_HD int64_t operator[](int64_t k) const { return items == nullptr ? single : items[k]; }
};

struct PathEnds {
  Vec3<double> start, end;
};

// Side 0 is i, 1 is j. Points of a body are relative to its reference: the body's origin or, of a body given by its
// vertices, the contact's point.
struct Site {
  const BodyPaths* paths;
  const Incidence* incidence;
  int kind;
  double coordinates[2], toi;
  Vec3<double> point;
  int64_t body[2], mesh[2], first_vertex[2];
  FeatureRow feature[2];
  int64_t corner[2][3];  // vertices of the feature; of an edge the second twice, of a vertex the same
  Quaternion at_toi[2], at_t0[2], at_t1[2];
  Vec3<double> between, change;  // from the reference of i to that of j at t = 0, and how that changes over the step
  Vec3<double> nearest[2];       // nearest points at toi
  Vec3<double> offset;           // from that of i to that of j
  double noise;                  // a length below which the offset may be rounding

  // Whether a row names bodies, features and vertices that exist.
  PGCCD_HD static bool exists(const BodyPaths& paths, const ContactInput& contacts, int64_t row) {
    const int kind = contacts.kind[row];
    if (kind < 0 || kind >= kKinds) return false;
    for (int side = 0; side < 2; ++side) {
      const int64_t body = contacts.bodies[2 * row + side], feature = contacts.features[2 * row + side];
      if (!is_within(body, paths.count) || !is_within(paths.mesh_index[body], paths.meshes.mesh_count)) return false;
      const MeshOffsets *begin = paths.meshes.offsets + paths.mesh_index[body], *end = begin + 1;
      const int64_t vertices = end->vertex - begin->vertex;
      const int what = contacts_detail::feature_of(kind, side);
      const int64_t count = what == kVertex ? vertices
                            : what == kFace ? end->face - begin->face
                                            : end->edge - begin->edge;
      if (!is_within(feature, count)) return false;
      if (paths.kind == PathKind::kVertices && !are_within(paths.vertex_begin[body], vertices, paths.vertex_count)) {
        return false;
      }
    }
    return true;
  }

  // Of a row that exists.
  PGCCD_HD static Site of(const BodyPaths& paths, const Incidence& incidence, const ContactInput& contacts,
                          int64_t row) {
    Site site;
    site.paths = &paths;
    site.incidence = &incidence;
    site.kind = contacts.kind[row];
    site.toi = contacts.toi[row];
    site.point = load_vec3(contacts.point + 3 * row);
    for (int side = 0; side < 2; ++side) {
      site.coordinates[side] = contacts.coordinates[2 * row + side];
      site.set_side(side, contacts.bodies[2 * row + side], contacts.features[2 * row + side]);
    }
    site.between = site.change = {0.0, 0.0, 0.0};
    if (paths.kind != PathKind::kVertices) {
      const auto at = [&](const double* column, int side) { return load_vec3(column + 3 * site.body[side]); };
      site.between = at(paths.position_t0, 1) - at(paths.position_t0, 0);
      site.change =
          (at(paths.position_t1, 1) - at(paths.position_t0, 1)) - (at(paths.position_t1, 0) - at(paths.position_t0, 0));
    }
    site.set_offset();
    return site;
  }

  PGCCD_HD Vec3<double> arm(int side, int64_t vertex) const {
    if (paths->kind == PathKind::kArcs) return contacts_detail::oriented(vertex_of_mesh(vertex), at_toi[side]);
    const PathEnds at = ends(side, vertex);
    return at.start + toi * (at.end - at.start);
  }

  // As `arm`, at both ends of the step; on arcs both are those at t = 0.
  PGCCD_HD PathEnds ends(int side, int64_t vertex) const {
    if (paths->kind == PathKind::kVertices) {
      const int64_t row = 3 * (paths->vertex_begin[body[side]] - first_vertex[side] + vertex);
      return {load_vec3(paths->vertices_t0 + row) - point, load_vec3(paths->vertices_t1 + row) - point};
    }
    const Vec3<double> v = vertex_of_mesh(vertex), start = contacts_detail::oriented(v, at_t0[side]);
    return {start, paths->kind == PathKind::kArcs ? start : contacts_detail::oriented(v, at_t1[side])};
  }

  // Of the nearest point of j relative to that of i, both fixed to their features, at toi, per step.
  PGCCD_HD Vec3<double> velocity() const {
    Vec3<double> rate[2];
    for (int side = 0; side < 2; ++side) {
      Vec3<double> corners[3];
      for (int k = 0; k < 3; ++k) {
        const int64_t vertex = corner[side][k];
        if (paths->kind == PathKind::kArcs) {
          corners[k] = cross(load_vec3(paths->rotation + 3 * body[side]), arm(side, vertex));
        } else {
          const PathEnds at = ends(side, vertex);
          corners[k] = at.end - at.start;
        }
      }
      rate[side] = weighted(side, corners);
    }
    return (rate[1] - rate[0]) + change;
  }

  // From the reference of a body at toi to the contact's point.
  PGCCD_HD Vec3<double> arm_of_point(int side) const {
    if (paths->kind == PathKind::kVertices) return {0.0, 0.0, 0.0};
    const Vec3<double> start = load_vec3(paths->position_t0 + 3 * body[side]);
    return point - (start + toi * (load_vec3(paths->position_t1 + 3 * body[side]) - start));
  }

  // Whether the features coincide up to rounding at a toi > 0, but recede by this normal: they were apart before, on
  // the other side.
  PGCCD_HD bool is_reversed(Vec3<double> normal) const {
    return contacts_detail::length_of(offset) <= noise && toi > 0.0 &&
           contacts_detail::dot_of(normal, velocity()) > 0.0;
  }

  // What of the surface of one side its nearest point lies on.
  PGCCD_HD FeatureRow support(int side) const {
    using contacts_detail::kBorder;
    const FeatureRow given = feature[side];
    if (given.what == kVertex) return given;
    if (given.what == kEdge) {
      const double at = coordinates[side];
      if (at > kBorder && at < 1.0 - kBorder) return given;
      return {kVertex, corner[side][at > 0.5 ? 1 : 0]};
    }
    const double u = coordinates[0], v = coordinates[1];
    const bool low_u = u <= kBorder, low_v = v <= kBorder, high = u + v >= 1.0 - kBorder;
    const int borders = low_u + low_v + high;
    if (borders == 0) return given;
    // From the first corner (v = 0), opposite of it, back to it (u = 0).
    if (borders == 1) return {kEdge, incidence->face_edges[3 * given.row + (low_v ? 0 : high ? 1 : 2)]};
    return {kVertex, corner[side][low_u && low_v ? 0 : low_v ? 1 : 2]};
  }

  PGCCD_HD FacesAround faces_around(FeatureRow around) const {
    if (around.what == kFace) return {nullptr, 1, around.row};
    const RowLists& lists = around.what == kVertex ? incidence->faces_of_vertex : incidence->faces_of_edge;
    const int64_t begin = lists.begin[around.row];
    return {lists.items + begin, lists.begin[around.row + 1] - begin, 0};
  }

  // A corner of a face of one side, as a row of all vertices.
  PGCCD_HD int64_t corner_of(int side, int64_t face, int k) const {
    return first_vertex[side] + paths->meshes.faces[3 * face + k];
  }

 private:
  PGCCD_HD Vec3<double> vertex_of_mesh(int64_t vertex) const { return load_vec3(paths->meshes.vertices + 3 * vertex); }

  PGCCD_HD void set_side(int side, int64_t of_body, int64_t of_feature) {
    body[side] = of_body;
    mesh[side] = paths->mesh_index[of_body];
    const MeshOffsets& begin = paths->meshes.offsets[mesh[side]];
    first_vertex[side] = begin.vertex;
    const int what = contacts_detail::feature_of(kind, side);
    feature[side] = {what, of_feature + (what == kVertex ? begin.vertex : what == kFace ? begin.face : begin.edge)};
    const int64_t row = feature[side].row;
    for (int k = 0; k < 3; ++k) {
      corner[side][k] = what == kVertex ? row
                        : what == kFace ? corner_of(side, row, k)
                                        : begin.vertex + paths->meshes.edges[2 * row + (k == 0 ? 0 : 1)];
    }
    if (paths->kind == PathKind::kVertices) return;
    const Quaternion start = load_quaternion(paths->orientation + 4 * of_body);
    const Vec3<double> rotation = load_vec3(paths->rotation + 3 * of_body);
    at_t0[side] = orientation_at(start, rotation, 0.0);
    at_toi[side] = orientation_at(start, rotation, toi);
    at_t1[side] = paths->kind == PathKind::kLines ? orientation_at(start, rotation, 1.0) : at_t0[side];
  }

  PGCCD_HD void set_offset() {
    using contacts_detail::length_of;
    double size = 0.0;
    for (int side = 0; side < 2; ++side) {
      Vec3<double> arms[3];
      for (int k = 0; k < 3; ++k) {
        const PathEnds at = ends(side, corner[side][k]);
        size = larger(length_of(at.start) + length_of(at.end - at.start), size);
        arms[k] = arm(side, corner[side][k]);
      }
      nearest[side] = weighted(side, arms);
    }
    offset = nearest[1] - nearest[0];
    if (paths->kind != PathKind::kVertices) offset = offset + (between + toi * change);
    noise = contacts_detail::kNoise * (size + length_of(between) + length_of(change));
  }

  // At the nearest point of one side what is given at the corners of its feature.
  PGCCD_HD Vec3<double> weighted(int side, const Vec3<double> (&at)[3]) const {
    if (feature[side].what == kVertex) return at[0];
    if (feature[side].what == kEdge) return at[0] + part_of_edge(side) * (at[1] - at[0]);
    return at[0] + (coordinates[0] * (at[1] - at[0]) + coordinates[1] * (at[2] - at[0]));
  }

  // Where on an edge the nearest point is, from 0 at its first vertex to 1 at its second.
  PGCCD_HD double part_of_edge(int side) const {
    // The coordinates of an edge that passes through a face are those of the point in the face.
    if (kind != kKindEFAB + side) return coordinates[side];
    const Vec3<double> start = arm(side, corner[side][0]), along = arm(side, corner[side][1]) - start;
    const double square = contacts_detail::dot_of(along, along);
    const double part = contacts_detail::dot_of(arm_of_point(side) - start, along) / (square > 0.0 ? square : 1.0);
    return unit_clamp(part);
  }
};

}  // namespace pgccd
