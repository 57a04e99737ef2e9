// Bounds of one node of a deforming body's hierarchy: spheres at both ends of the step with one radius, and a slab.
#pragma once

#include "core/mesh_set.h"
#include "core/rounding.h"

namespace pgccd {

// One body's vertices at t0 and t1 (world), and its centres.
struct BodyShape {
  const double* vertices[2];
  Vec3<double> centre[2];

  PGCCD_HD Vec3<double> local(int end, int32_t vertex) const {
    return load_vec3(vertices[end] + 3 * int64_t(vertex)) - centre[end];
  }
};

// Threads that measure a node together, each a range of its triangles. All get the result of a single thread, bit for
// bit: ranges are combined in order. On the host a thread is alone.
struct SingleThread {
  static constexpr int kCount = 1;
  PGCCD_HD int index() const { return 0; }
  PGCCD_HD double from(double x, int) const { return x; }  // the value of a thread
};

// Bounds of a node at both ends of the step, relative to the body's centre.
struct NodeBounds {
  Vec3<double> lower[2], upper[2];
  Vec3<float> centre[2];
  double radius;
  Vec3<double> area_normal;  // sum of the triangles' cross products over both ends
  Vec3<float> normal;
  double low[2], high[2];  // along the normal, from the centres
  int32_t first_triangle, triangle_count;
};

namespace refit_detail {

struct Range {
  int32_t begin, end;
};
// A thread's triangles.
template <class Team>
PGCCD_HD Range share_of(const Team& team, const NodeBounds& node) {
  const auto bound = [&](int index) { return node.first_triangle + node.triangle_count * index / Team::kCount; };
  return {bound(team.index()), bound(team.index() + 1)};
}

template <class Team, class Combine>
PGCCD_HD double combined(const Team& team, double x, const Combine& combine) {
  double all = team.from(x, 0);
  for (int other = 1; other < Team::kCount; ++other) all = combine(all, team.from(x, other));
  return all;
}
template <class Team>
PGCCD_HD double smallest(const Team& team, double x) {
  return combined(team, x, [](double a, double b) { return smaller(a, b); });
}
template <class Team>
PGCCD_HD double largest(const Team& team, double x) {
  return combined(team, x, [](double a, double b) { return larger(a, b); });
}

PGCCD_HD Vec3<double> lower_corner(Vec3<double> a, Vec3<double> b) {
  return {smaller(a.x, b.x), smaller(a.y, b.y), smaller(a.z, b.z)};
}
PGCCD_HD Vec3<double> upper_corner(Vec3<double> a, Vec3<double> b) {
  return {larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)};
}
PGCCD_HD void place_centres(NodeBounds& node) {
  for (int end = 0; end < 2; ++end) node.centre[end] = cast<float>(0.5 * (node.lower[end] + node.upper[end]));
}

// Sphere and slab from the node's own vertices.
template <class Team>
PGCCD_HD void measure(const Team& team, const BodyShape& shape, const Triangle* triangles, NodeBounds& node) {
  double squared = 0.0;
  double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
  const Range range = share_of(team, node);
  for (int32_t k = range.begin; k < range.end; ++k) {
    for (int corner = 0; corner < 3; ++corner) {
      for (int end = 0; end < 2; ++end) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]) - cast<double>(node.centre[end]);
        squared = larger(squared, norm_squared(x));
        const double along = dot(cast<double>(node.normal), x);
        low[end] = smaller(low[end], along);
        high[end] = larger(high[end], along);
      }
    }
  }
  node.radius = std::sqrt(largest(team, squared));
  for (int end = 0; end < 2; ++end) {
    node.low[end] = smallest(team, low[end]);
    node.high[end] = largest(team, high[end]);
  }
}

PGCCD_HD void set_normal(NodeBounds& node) {
  const double length = norm(node.area_normal);
  node.normal = length > 0.0 ? cast<float>((1.0 / length) * node.area_normal) : Vec3<float>{0.0f, 0.0f, 1.0f};
}

}  // namespace refit_detail

template <class Team>
PGCCD_HD NodeBounds leaf_bounds(const Team& team, const BodyShape& shape, const Triangle* triangles, NodeLink link) {
  NodeBounds node{};
  node.first_triangle = link.first;
  node.triangle_count = link.triangle_count;
  const refit_detail::Range range = refit_detail::share_of(team, node);
  for (int end = 0; end < 2; ++end) {
    Vec3<double> lower{INFINITY, INFINITY, INFINITY}, upper = -lower;
    for (int32_t k = range.begin; k < range.end; ++k) {
      for (int corner = 0; corner < 3; ++corner) {
        const Vec3<double> x = shape.local(end, triangles[k].vertex[corner]);
        lower = refit_detail::lower_corner(lower, x);
        upper = refit_detail::upper_corner(upper, x);
      }
    }
    using refit_detail::largest, refit_detail::smallest;
    node.lower[end] = {smallest(team, lower.x), smallest(team, lower.y), smallest(team, lower.z)};
    node.upper[end] = {largest(team, upper.x), largest(team, upper.y), largest(team, upper.z)};
  }
  Vec3<double> sum{0.0, 0.0, 0.0};
  for (int turn = 0; turn < Team::kCount; ++turn) {
    if (team.index() == turn) {
      for (int32_t k = range.begin; k < range.end; ++k) {
        for (int end = 0; end < 2; ++end) {
          const Vec3<double> p = shape.local(end, triangles[k].vertex[0]);
          const Vec3<double> a = shape.local(end, triangles[k].vertex[1]) - p,
                             b = shape.local(end, triangles[k].vertex[2]) - p;
          sum = sum + cross(a, b);
        }
      }
    }
    sum = {team.from(sum.x, turn), team.from(sum.y, turn), team.from(sum.z, turn)};
  }
  node.area_normal = sum;
  refit_detail::place_centres(node);
  refit_detail::set_normal(node);
  refit_detail::measure(team, shape, triangles, node);
  return node;
}

// Small nodes measure their vertices; large ones take the smaller of two bounds, from the box's corner and from the
// children's spheres.
template <class Team>
PGCCD_HD NodeBounds parent_bounds(const Team& team, const BodyShape& shape, const Triangle* triangles,
                                  const NodeBounds* children, int count) {
  constexpr int32_t kMeasured = 32;
  NodeBounds node = children[0];
  for (int c = 1; c < count; ++c) {
    node.triangle_count += children[c].triangle_count;
    node.area_normal = node.area_normal + children[c].area_normal;
    for (int end = 0; end < 2; ++end) {
      node.lower[end] = refit_detail::lower_corner(node.lower[end], children[c].lower[end]);
      node.upper[end] = refit_detail::upper_corner(node.upper[end], children[c].upper[end]);
    }
  }
  refit_detail::place_centres(node);
  refit_detail::set_normal(node);
  if (node.triangle_count <= kMeasured) {
    refit_detail::measure(team, shape, triangles, node);
    return node;
  }
  double by_children = 0.0, by_box = 0.0;
  for (int end = 0; end < 2; ++end) {
    const Vec3<double> centre = cast<double>(node.centre[end]);
    for (int c = 0; c < count; ++c) {
      by_children = larger(by_children, norm(cast<double>(children[c].centre[end]) - centre) + children[c].radius);
    }
    by_box = larger(by_box, norm(refit_detail::upper_corner(node.upper[end] - centre, centre - node.lower[end])));
  }
  node.radius = smaller(by_children, by_box);
  for (int end = 0; end < 2; ++end) {
    node.low[end] = -node.radius;
    node.high[end] = node.radius;
  }
  return node;
}

}  // namespace pgccd
