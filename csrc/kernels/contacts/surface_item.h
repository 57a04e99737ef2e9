// The normal of the surfaces at a contact: of those that the faces around its nearest points admit, the one nearest to
// the normal of its features.
#pragma once

#include <cstring>

#include "kernels/contacts/site_item.h"

namespace pgccd {

// A face at the nearest point of one side.
struct RingFace {
  int64_t row;
  Vec3<double> away[3];  // corners, relative to the point; one at the point is zero
  Vec3<double> normal;   // unit, or zero without an area; by the order of the corners, then from i to j
};

// A convex edge at the nearest point of one side.
struct RingEdge {
  Vec3<double> along;    // unit
  Vec3<double> apex[2];  // points of its faces that are not on it, relative to the nearest point; of one face twice
};

namespace contacts_detail {

// Sines of angles below which faces count as coplanar, and points as in a plane.
constexpr double kFlat = 1e-5;
// A point is at a corner of a face if it is nearer to it than this part of the distance to the farthest one.
constexpr double kAtCorner = 0x1p-40;
// A surface is on one side of a plane if it reaches this many times as far there as on the other.
constexpr double kOneSided = 1e5;

template <class T>
PGCCD_HD bool have_equal_bits(const T& a, const T& b) {
  static_assert(sizeof(T) % sizeof(double) == 0 && alignof(T) == alignof(double), "has no padding, which is not set");
  uint64_t of_a[sizeof(T) / sizeof(double)], of_b[sizeof(T) / sizeof(double)], differ = 0;
  memcpy(of_a, &a, sizeof(T));
  memcpy(of_b, &b, sizeof(T));
  for (size_t k = 0; k < sizeof(T) / sizeof(double); ++k) differ |= of_a[k] ^ of_b[k];
  return differ == 0;
}
PGCCD_HD double sign_of(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0; }
PGCCD_HD bool is_nonzero(Vec3<double> v) { return length_of(v) > 0.0; }

// Whether a point is behind the plane through the origin with this normal, or in it.
PGCCD_HD bool is_behind(Vec3<double> normal, Vec3<double> at) { return dot_of(normal, at) <= kFlat * length_of(at); }

}  // namespace contacts_detail

// The surface of one side around the nearest point, in memory of the caller.
struct Ring {
  RingFace* faces;  // room for Incidence::most
  RingEdge* edges;  // the same
  int64_t face_count, edge_count;
  FeatureRow support;
  double outside;          // normals from i to j point out of i and into j
  double solid;            // of the mesh, see Incidence::outward
  Vec3<double> first_out;  // the normal of the first face that points out of a closed mesh; 0 of other meshes
  double over;      // on which side of the surface the other one's point is, by the face that it is over; 0: unknown
  bool is_guessed;  // only the normal of the features tells on which side the surface is

  PGCCD_HD void set_faces(const Site& site, int side) {
    using namespace contacts_detail;
    support = site.support(side);
    outside = side == 1 ? -1.0 : 1.0;
    solid = site.incidence->outward[site.mesh[side]];
    const FacesAround around = site.faces_around(support);
    face_count = around.count;
    for (int64_t f = 0; f < face_count; ++f) {
      RingFace& face = faces[f];
      face.row = around[f];
      double length[3], longest = 0.0;
      for (int k = 0; k < 3; ++k) {
        face.away[k] = site.arm(side, site.corner_of(side, face.row, k)) - site.nearest[side];
        longest = larger(length[k] = length_of(face.away[k]), longest);
      }
      for (int k = 0; k < 3; ++k) {
        if (!(length[k] > kAtCorner * longest)) face.away[k] = {0.0, 0.0, 0.0};
      }
      face.normal = unit_or_zero(cross(face.away[1] - face.away[0], face.away[2] - face.away[0]));
    }
    first_out = face_count > 0 ? solid * faces[0].normal : Vec3<double>{0.0, 0.0, 0.0};
  }

  // `towards`: from this surface to the other one.
  PGCCD_HD void set_over(Vec3<double> towards, double noise) {
    using namespace contacts_detail;
    double above = INFINITY, below = INFINITY;
    for (int64_t f = 0; f < face_count; ++f) {
      const RingFace& face = faces[f];
      const double height = dot_of(face.normal, towards);
      bool is_over = magnitude(height) > noise;
      for (int k = 0; k < 3 && is_over; ++k) {
        const Vec3<double> start = face.away[k], inward = cross(face.normal, face.away[(k + 1) % 3] - start);
        const bool is_elsewhere = -dot_of(inward, start) > kFlat * length_of(inward) * length_of(start);
        is_over = is_elsewhere || dot_of(inward, towards) >= 0.0;
      }
      if (!is_over) continue;
      if (height > 0.0) above = smaller(above, height);
      if (height < 0.0) below = smaller(below, -height);
    }
    over = (above < below ? 1.0 : 0.0) - (below < above ? 1.0 : 0.0);
  }

  // 1 where the normal by the order of a face's corners points to where the other surface is, -1 where it points away:
  // by the nearest points, on a closed mesh by the face that they are over; where they coincide by the other surface
  // around the point, if it is on one side; then by the order of corners of a closed mesh, this one or the other. 0:
  // neither tells.
  PGCCD_HD double sign_out(const RingFace& face, const Ring& other, Vec3<double> towards, double noise) const {
    using namespace contacts_detail;
    const double height = dot_of(towards, face.normal);
    double sign = magnitude(height) > noise ? sign_of(height) : 0.0;
    if (sign == 0.0) {
      double reach = 0.0, back = 0.0;
      for (int64_t f = 0; f < other.face_count; ++f) {
        for (int k = 0; k < 3; ++k) {
          const double up = dot_of(face.normal, other.faces[f].away[k]);
          reach = larger(up, reach);
          back = larger(-up, back);
        }
      }
      sign = (reach > kOneSided * back ? 1.0 : 0.0) - (back > kOneSided * reach ? 1.0 : 0.0);
    }
    // Beside an edge the other surface is behind the plane of one face, though not within the solid.
    if (over != 0.0 && solid != 0.0) sign = over;
    if (sign == 0.0) sign = solid;
    const double facing = -dot_of(other.first_out, face.normal);
    return sign == 0.0 && magnitude(facing) > 0.5 ? sign_of(facing) : sign;
  }

  // `of_features`: from i to j.
  PGCCD_HD void orient(const Ring& other, Vec3<double> towards, double noise, Vec3<double> of_features) {
    using namespace contacts_detail;
    is_guessed = false;
    for (int64_t f = 0; f < face_count; ++f) {
      RingFace& face = faces[f];
      double sign = sign_out(face, other, towards, noise);
      if (sign == 0.0) {
        is_guessed = is_guessed || is_nonzero(face.normal);
        sign = sign_of(dot_of(outside * of_features, face.normal));
      }
      face.normal = (outside * (sign == 0.0 ? 1.0 : sign)) * face.normal;
    }
  }

  PGCCD_HD void set_edges(const Site& site, int side) {
    edge_count = 0;
    if (support.what == kFace) return;
    if (support.what == kEdge) return add_edge(site, side, support.row);
    const RowLists& lists = site.incidence->edges_of_vertex;
    for (int64_t k = lists.begin[support.row]; k < lists.begin[support.row + 1]; ++k) {
      add_edge(site, side, lists.items[k]);
    }
  }

  // Whether some edge is convex, and all faces are behind the plane with this normal.
  PGCCD_HD bool admits(Vec3<double> normal) const {
    using namespace contacts_detail;
    if (edge_count == 0 || !is_nonzero(normal)) return false;
    const Vec3<double> out = outside * normal;
    for (int64_t f = 0; f < face_count; ++f) {
      for (int k = 0; k < 3; ++k) {
        if (!is_behind(out, faces[f].away[k])) return false;
      }
    }
    return true;
  }

  // Mean of the normals of the faces around a vertex, of unit length or zero, with the weights of Max (1999): those
  // give the normal of a sphere if all vertices are on it.
  PGCCD_HD Vec3<double> mean() const {
    double largest = 0.0;
    for (int64_t f = 0; f < face_count; ++f) largest = larger(weight(faces[f]), largest);
    Vec3<double> sum{0.0, 0.0, 0.0};
    for (int64_t f = 0; f < face_count; ++f) {
      sum = sum + (weight(faces[f]) / (largest > 0.0 ? largest : 1.0)) * faces[f].normal;
    }
    return contacts_detail::unit_or_zero(sum);
  }

  // Twice its area.
  PGCCD_HD double largest_face() const {
    double largest = 0.0;
    for (int64_t f = 0; f < face_count; ++f) {
      const auto& away = faces[f].away;
      largest = larger(contacts_detail::length_of(cross(away[1] - away[0], away[2] - away[0])), largest);
    }
    return largest;
  }

  // Of the normals that this surface may have the one nearest to a normal.
  PGCCD_HD_RARE Vec3<double> nearest(Vec3<double> normal) const {
    using namespace contacts_detail;
    if (admits(normal)) return normal;
    Vec3<double> best = normal;
    double nearness = -INFINITY;
    const auto offer = [&](Vec3<double> candidate) {
      const double near = dot_of(normal, candidate);
      if (near > nearness) nearness = near, best = candidate;
    };
    for (int64_t f = 0; f < face_count; ++f) {
      if (is_nonzero(faces[f].normal)) offer(faces[f].normal);
    }
    // In the plane across a convex edge.
    for (int64_t e = 0; e < edge_count; ++e) {
      const RingEdge& edge = edges[e];
      const Vec3<double> across = unit_or_zero(normal - dot_of(normal, edge.along) * edge.along);
      const Vec3<double> out = outside * across;
      if (is_behind(out, edge.apex[0]) && is_behind(out, edge.apex[1]) && is_nonzero(across)) offer(across);
    }
    return best;
  }

 private:
  PGCCD_HD const RingFace& face_of(int64_t row) const {
    int64_t f = 0;
    while (f + 1 < face_count && faces[f].row != row) ++f;
    return faces[f];
  }

  // Appends an edge if it is convex: of one face it is, of three or more not.
  PGCCD_HD void add_edge(const Site& site, int side, int64_t row) {
    using namespace contacts_detail;
    const RowLists& lists = site.incidence->faces_of_edge;
    const int64_t begin = lists.begin[row], count = lists.begin[row + 1] - begin;
    const int32_t* const ends = site.paths->meshes.edges + 2 * row;
    if (count > 2) return;
    const auto away = [&](int k) { return site.arm(side, site.first_vertex[side] + ends[k]) - site.nearest[side]; };
    const Vec3<double> start = away(0);
    RingEdge edge;
    edge.along = unit_or_zero(away(1) - start);
    if (!is_nonzero(edge.along)) return;
    for (int k = 0; k < 2; ++k) {
      const RingFace& face = face_of(lists.items[count > 1 ? begin + k : begin]);
      const int32_t* const vertices = site.paths->meshes.faces + 3 * face.row;
      int off = 0;
      while (off < 2 && (vertices[off] == ends[0] || vertices[off] == ends[1])) ++off;
      edge.apex[k] = face.away[off];
    }
    const Vec3<double> normal = outside * face_of(lists.items[begin]).normal, of_apex = edge.apex[1] - start;
    const double distance = length_of(of_apex - dot_of(of_apex, edge.along) * edge.along);
    if (count == 1 || dot_of(normal, of_apex) < -kFlat * distance) edges[edge_count++] = edge;
  }

  PGCCD_HD static double weight(const RingFace& face) {
    using namespace contacts_detail;
    int corner = 0;
    for (int k = 1; k < 3; ++k) {
      if (length_of(face.away[k]) < length_of(face.away[corner])) corner = k;
    }
    const Vec3<double> a = face.away[(corner + 1) % 3], b = face.away[(corner + 2) % 3];
    const double squares = dot_of(a, a) * dot_of(b, b);
    return length_of(cross(a, b)) / (squares > 0.0 ? squares : 1.0);
  }
};

// What the surfaces at a contact depend on: contacts whose places are equal to the bit have the same surfaces, as where
// vertices of many faces meet.
struct Place {
  int64_t body[2];
  FeatureRow support[2];
  double toi, noise;
  Vec3<double> offset, nearest[2], point;

  PGCCD_HD static Place of(const Site& site) {
    Place place;
    for (int side = 0; side < 2; ++side) {
      place.body[side] = site.body[side];
      place.support[side] = site.support(side);
      place.nearest[side] = site.nearest[side];
    }
    place.toi = site.toi;
    // Otherwise no height above a face exceeds the noise.
    const bool is_apart = contacts_detail::length_of(site.offset) > 0.5 * site.noise;
    place.noise = is_apart ? site.noise : 0.0;
    place.offset = is_apart ? site.offset : Vec3<double>{0.0, 0.0, 0.0};
    place.point = site.paths->kind == PathKind::kVertices ? site.point : Vec3<double>{0.0, 0.0, 0.0};
    return place;
  }

  // By bits: the sign of a zero may pass on to the normal.
  PGCCD_HD bool operator==(const Place& other) const { return contacts_detail::have_equal_bits(*this, other); }
};

// The surfaces of both sides at the contact seen last, with what they do not depend on its normal.
struct Surfaces {
  Ring ring[2];
  bool is_set = false;
  Place place;
  Vec3<double> of_features;
  bool last_is_one;  // the surface of i has the last word
  bool has_mean;     // all normals are `of_mean`
  Vec3<double> of_mean;

  // `faces` and `edges` have room for 2 `most` rows.
  PGCCD_HD Surfaces(RingFace* faces, RingEdge* edges, int64_t most) {
    for (int side = 0; side < 2; ++side) ring[side].faces = faces + side * most, ring[side].edges = edges + side * most;
  }

  // The unit normal of the surfaces from i to j, from that of the features. Those of contacts at vertices of many
  // faces, which follow one another, are worked out once.
  PGCCD_HD Vec3<double> normal(const Site& site, Vec3<double> given) {
    using namespace contacts_detail;
    if (site.is_reversed(given)) given = -given;
    // Parallel edges that coincide have none.
    if (!is_nonzero(given)) given = -unit_or_zero(site.velocity());
    const Place at = Place::of(site);
    const bool is_guessed = is_set && (ring[0].is_guessed || ring[1].is_guessed);
    if (!is_set || !(at == place) || (is_guessed && !have_equal_bits(given, of_features))) set(site, at, given);
    return has_mean ? of_mean : nearest(given);
  }

 private:
  PGCCD_HD_RARE void set(const Site& site, const Place& at, Vec3<double> given) {
    using namespace contacts_detail;
    is_set = true;
    place = at;
    of_features = given;
    const Vec3<double> towards[2] = {place.offset, -place.offset};
    for (int side = 0; side < 2; ++side) {
      ring[side].set_faces(site, side);
      ring[side].set_over(towards[side], place.noise);
    }
    // Each reads only the corners of the other.
    for (int side = 0; side < 2; ++side) ring[side].orient(ring[1 - side], towards[side], place.noise, given);
    for (int side = 0; side < 2; ++side) ring[side].set_edges(site, side);
    const Ring &one = ring[0], &other = ring[1];
    // A surface with few directions has the last word; of two that are flat there, the one with the larger face.
    last_is_one = one.support.what == kFace || (one.edge_count == 0 && other.support.what != kFace &&
                                                (other.edge_count > 0 || one.largest_face() > other.largest_face()));
    // Vertices that coincide have no direction of their own.
    has_mean = false;
    if (length_of(place.offset) <= place.noise && one.support.what == kVertex && other.support.what == kVertex) {
      const Vec3<double> mean = unit_or_zero(one.mean() + other.mean());
      has_mean = one.admits(mean) && other.admits(mean);
      of_mean = nearest(mean);
    }
  }

  PGCCD_HD Vec3<double> nearest(Vec3<double> normal) const {
    return last_is_one ? ring[0].nearest(ring[1].nearest(normal)) : ring[1].nearest(ring[0].nearest(normal));
  }
};

}  // namespace pgccd
