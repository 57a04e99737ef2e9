// Tests of the bounding volume test tree: whether two moving spheres, triangles or features certainly stay apart over a
// segment. For T = float and, on the host, for eight lanes of it.
#pragma once

#include "core/lanes.h"
#include "core/rounding.h"

namespace pgccd {

// Offset of one centre from the other, at the start and the end of a segment, both moving straight. Without branches,
// so that eight tests fill the lanes of a vector unit; NaN (an empty slot) compares false.
PGCCD_HD Vec3<float> nearest_offset(Vec3<float> start, Vec3<float> end) {
  const Vec3<float> travel = end - start;
  return start + unit_clamp(-dot(start, travel) / norm_squared(travel)) * travel;  // 0 / 0 becomes 0
}

// A slab that moves with its centre over a segment: thick enough along a fixed direction for both ends of the segment.
struct MovingSlab {
  Vec3<float> direction;  // the mean of the normals at both ends
  float low, high;
};

// True if a sphere is certainly on one side of the slab, given the offsets of its centre from the slab's.
PGCCD_HD bool slab_separates(const MovingSlab& slab, Vec3<float> start, Vec3<float> end, float reach) {
  const float along_start = dot(slab.direction, start), along_end = dot(slab.direction, end);
  const float above = smaller(along_start, along_end) - slab.high;
  const float below = slab.low - larger(along_start, along_end);
  return larger(above, below) > reach;
}

// The convex hull of N points that move straight from start to end.
template <int N, class T>
struct MovingPoints {
  Vec3<T> start[N];
  Vec3<T> end[N];
};

namespace overlap_detail {

template <class T>
struct Range {
  T lower, upper;
};

template <int N, class T>
PGCCD_HD Range<T> project(const Vec3<T> (&x)[N], Vec3<T> direction) {
  T first = dot(direction, x[0]);
  Range<T> range{first, first};
  for (int k = 1; k < N; ++k) {
    const T p = dot(direction, x[k]);
    range.lower = smaller(range.lower, p);
    range.upper = larger(range.upper, p);
  }
  return range;
}

// The least gap of projections on a direction for which sets are certainly further apart than `distance`. False if the
// direction has no length.
template <class T>
PGCCD_HD auto find_least_gap(Vec3<T> direction, float distance, T& gap) {
  const T length_squared = norm_squared(direction);
  gap = square_root(length_squared) * (distance * (1.0f + 8.0f * Precision<float>::unit));
  return length_squared > 1e-30f;
}

template <int N, class T>
PGCCD_HD Vec3<T> sum(const Vec3<T> (&x)[N]) {
  Vec3<T> total = x[0];
  for (int k = 1; k < N; ++k) total = total + x[k];
  return total;
}

// Mean over the segment of the edge from point 0 to point `tip`, times 2.
template <int N, class T>
PGCCD_HD Vec3<T> mean_edge(const MovingPoints<N, T>& p, int tip) {
  return (p.start[tip] - p.start[0]) + (p.end[tip] - p.end[0]);
}

}  // namespace overlap_detail

// Along a fixed direction the gap between convex sets on straight paths is concave in time: positive at both ends, it
// is positive throughout.
template <int N, int M, class T>
PGCCD_HD auto separates(const MovingPoints<N, T>& i, const MovingPoints<M, T>& j, Vec3<T> direction, float distance) {
  using namespace overlap_detail;
  T gap;
  const auto has_length = find_least_gap(direction, distance, gap);
  const Range<T> i0 = project(i.start, direction), j0 = project(j.start, direction);
  const Range<T> i1 = project(i.end, direction), j1 = project(j.end, direction);
  const auto j_above = (j0.lower - i0.upper > gap) & (j1.lower - i1.upper > gap);
  const auto i_above = (i0.lower - j0.upper > gap) & (i1.lower - j1.upper > gap);
  return has_length & (j_above | i_above);
}

// True where two triangles certainly stay further apart than `distance` over the whole segment.
template <class T>
PGCCD_HD auto triangles_stay_apart(const MovingPoints<3, T>& i, const MovingPoints<3, T>& j, float distance) {
  using namespace overlap_detail;
  const Vec3<T> start = sum(j.start) - sum(i.start);
  const Vec3<T> end = sum(j.end) - sum(i.end);
  const auto direction = [&](int k) -> Vec3<T> {
    switch (k) {
      case 0:
        return start + end;
      case 1:
        return cross(mean_edge(i, 1), mean_edge(i, 2));
      case 2:
        return cross(mean_edge(j, 1), mean_edge(j, 2));
      case 3:
        return start;
      default:
        return end;
    }
  };
  auto apart = separates(i, j, direction(0), distance);
  PGCCD_KEEP_LOOP
  for (int k = 1; k < 5 && !all_lanes(apart); ++k) apart = apart | separates(i, j, direction(k), distance);
  return apart;
}

// True where two point sets at rest are certainly further apart than `distance` along a direction.
template <int N, int M, class T>
PGCCD_HD auto separates(const Vec3<T> (&i)[N], const Vec3<T> (&j)[M], Vec3<T> direction, float distance) {
  using namespace overlap_detail;
  T gap;
  const auto has_length = find_least_gap(direction, distance, gap);
  const Range<T> of_i = project(i, direction), of_j = project(j, direction);
  return has_length & ((of_j.lower - of_i.upper > gap) | (of_i.lower - of_j.upper > gap));
}

// True where a triangle at rest is certainly outside of a sphere.
template <class T>
PGCCD_HD auto is_outside(const Vec3<T> (&triangle)[3], const Vec3<T> (&centre)[1], float reach) {
  using namespace overlap_detail;
  const auto out = separates(triangle, centre, sum(triangle) - 3.0f * centre[0], reach);
  if (all_lanes(out)) return out;
  return out | separates(triangle, centre, cross(triangle[1] - triangle[0], triangle[2] - triangle[0]), reach);
}

// True where two triangles at rest are certainly further apart than `distance` along the normal of one. `out` where the
// answer is not needed.
template <class T, class Mask>
PGCCD_HD Mask planes_separate(const Vec3<T> (&i)[3], const Vec3<T> (&j)[3], float distance, Mask out) {
  out = out | separates(i, j, cross(i[1] - i[0], i[2] - i[0]), distance);
  if (all_lanes(out)) return out;
  return out | separates(i, j, cross(j[1] - j[0], j[2] - j[0]), distance);
}

// The same along a direction perpendicular to an edge of each.
template <class T, class Mask>
PGCCD_HD Mask edges_separate(const Vec3<T> (&i)[3], const Vec3<T> (&j)[3], float distance, Mask out) {
  const Vec3<T> side_i[3] = {i[1] - i[0], i[2] - i[1], i[0] - i[2]},
                side_j[3] = {j[1] - j[0], j[2] - j[1], j[0] - j[2]};
  for (const Vec3<T>& a : side_i) {
    for (const Vec3<T>& b : side_j) {
      if (all_lanes(out)) return out;
      out = out | separates(i, j, cross(a, b), distance);
    }
  }
  return out;
}

// True where an edge and a face at rest are certainly further apart than `distance` along the face's normal, a
// direction perpendicular to the edge and an edge of the face, or one within the face's plane, which separates coplanar
// neighbours.
template <class T, class Mask>
PGCCD_HD Mask edge_and_face_apart(const Vec3<T> (&edge)[2], const Vec3<T> (&face)[3], float distance, Mask out) {
  const Vec3<T> along = edge[1] - edge[0];
  const Vec3<T> side[3] = {face[1] - face[0], face[2] - face[1], face[0] - face[2]};
  const Vec3<T> normal = cross(face[1] - face[0], face[2] - face[0]);
  out = out | separates(edge, face, normal, distance);
  for (const Vec3<T>& across : {along, normal}) {
    PGCCD_UNROLL
    for (int k = 0; k < 3; ++k) {
      if (all_lanes(out)) return out;
      out = out | separates(edge, face, cross(across, side[k]), distance);
    }
  }
  return out | separates(edge, face, cross(normal, along), distance);
}

// True if a triangle certainly stays outside of a moving sphere. Cheap, and saves whole rows of triangle tests.
template <class T>
PGCCD_HD auto stays_out(const MovingPoints<3, T>& triangle, const MovingPoints<1, T>& centre, float reach) {
  using namespace overlap_detail;
  const Vec3<T> start = sum(triangle.start) - 3.0f * centre.start[0], end = sum(triangle.end) - 3.0f * centre.end[0];
  auto out = separates(triangle, centre, start + end, reach);
  if (all_lanes(out)) return out;
  return out | separates(triangle, centre, cross(mean_edge(triangle, 1), mean_edge(triangle, 2)), reach);
}

}  // namespace pgccd
