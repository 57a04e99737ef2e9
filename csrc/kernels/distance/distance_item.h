// The distance of one body pair over a step, by branch and bound: over pairs of nodes of both hierarchies, and over
// parts of the step. Depth first, the nearer nodes first; so the memory of a search is bounded, and its result does not
// depend on what else runs.
#pragma once

#include "kernels/distance/distance.h"
#include "kernels/distance/node_gap_item.h"
#include "kernels/distance/triangle_gap_item.h"

namespace pgccd {

// Two nodes over a part of the step, with a lower bound of their distance.
struct DistanceTask {
  int32_t node[2];
  TimePart part;
  double bound;
};

// Tasks that a search keeps. A search that needs more, which no tree of usual depth does, and one of more work ends
// with the bounds that it has. Parts of the step have at least 2^-kFinestLevel of its length.
constexpr int kDistanceTasks = 256;
constexpr int32_t kFinestLevel = 26;
// Work is counted in looks at two triangles, some microseconds each on a CPU. The nodes of a task take about as much as
// two of these at each end of the part of the step.
constexpr int kWorkOfTask = 2;
constexpr int kMostDistanceWork = 3 << 16;
constexpr int kMostCoarseWork = 1 << 16;

// Triangles of a leaf at both ends of a part of the step.
struct LeafOver {
  int count;
  const Triangle* triangles;
  Corners3 at[2][kMaxLeafTriangles];
};

// Memory of a search.
struct DistanceMemory {
  DistanceTask tasks[kDistanceTasks];
  LeafOver leaves[2];
};

// Bounds of the distance of the surfaces without margins.
struct DistanceFound {
  double lower, upper, time;
  Vec3<double> point[2];  // relative to the first body's reference point at that time
};

struct DistanceGoal {
  double touching;   // the search ends when the upper bound is no larger: both margins, their sum rounded down
  double least;      // bounds below do not matter: the same, rounded up
  double cutoff;     // larger distances do not matter
  double tolerance;  // nor does whether a distance is less than the upper bound by so much
};

template <class Pair>
class DistanceSearch {
 public:
  PGCCD_HD DistanceSearch(const Pair& pair, const DistanceGoal& goal, DistanceMemory& memory)
      : pair_(pair), goal_(goal), memory_(memory), over_(pair, TimePart{0, 0}) {
    // Below the rounding of its bounds a search would not end. What stands still has no better ones. Subtracting
    // margins rounds once more.
    const double least = 4.0 * pair.rounding();
    goal_.tolerance = pair.is_still() ? least : larger(goal.tolerance - pair.rounding(), least);
    links_[0] = links_of(0);
    links_[1] = links_of(1);
    triangles_[0] = triangles_of(0);
    triangles_[1] = triangles_of(1);
  }

  PGCCD_HD DistanceFound run() {
    work_ = kMostDistanceWork;
    double lower = search(goal_.tolerance);
    // A search that is cut off may leave much of the step with the bounds of whole bodies: coarse ones, of ever smaller
    // parts of the upper bound, do not.
    if (!(work_ > 0)) {
      work_ = kMostCoarseWork;
      for (double part = 0.875; work_ > 0 && part > 0.01 && found_.upper < INFINITY; part *= 0.5) {
        lower = larger(search(part * (found_.upper - goal_.least)), lower);
      }
    }
    found_.lower = smaller(lower, found_.upper);
    return found_;
  }

 private:
  // The lower bound that a search to this tolerance gives.
  PGCCD_HD double search(double tolerance) {
    tolerance_ = larger(tolerance, goal_.tolerance);
    found_.lower = INFINITY;
    count_ = 0;
    move_to({0, 0});
    add({{0, 0}, {0, 0}, larger(over_.apart, goal_.least)});
    while (count_ > 0 && found_.upper > goal_.touching) {
      const DistanceTask task = memory_.tasks[--count_];
      if (is_decided(task.bound) || !(work_ > 0)) {
        dismiss(task.bound);
        continue;
      }
      work_ -= kWorkOfTask * over_.ends;
      visit(task);
    }
    if (!(found_.upper > goal_.touching)) dismiss(0.0);
    return found_.lower;
  }

  PGCCD_HD const MeshOffsets& offsets_of(int side) const {
    return pair_.bodies().meshes.offsets[pair_.bodies().mesh_index[pair_.body(side)]];
  }
  PGCCD_HD const NodeLink* links_of(int side) const {
    return pair_.bodies().meshes.node_links + offsets_of(side).block * kBlockWidth;
  }
  PGCCD_HD const Triangle* triangles_of(int side) const {
    return pair_.bodies().meshes.triangles + offsets_of(side).face;
  }

  // Distances of at least so much matter to neither bound.
  PGCCD_HD double enough() const { return smaller(found_.upper - tolerance_, goal_.cutoff); }
  PGCCD_HD bool is_decided(double bound) const { return bound >= enough(); }
  PGCCD_HD void dismiss(double bound) { found_.lower = smaller(found_.lower, bound); }
  PGCCD_HD void add(const DistanceTask& task) {
    if (is_decided(task.bound) || count_ == kDistanceTasks) return dismiss(task.bound);
    memory_.tasks[count_++] = task;
  }
  PGCCD_HD void move_to(TimePart part) {
    if (part == part_) return;
    part_ = part;
    over_ = PairOver<Pair>(pair_, part);
  }

  PGCCD_HD void visit(const DistanceTask& task) {
    move_to(task.part);
    NodeOver nodes[2] = {node_over(pair_, over_, 0, task.node[0]), node_over(pair_, over_, 1, task.node[1])};
    const NodeLink link[2] = {links_[0][task.node[0]], links_[1][task.node[1]]};
    // Bounds over a part of the step whose chords stray further, in radii of the nodes, seldom suffice.
    constexpr double kMostDeviation = 0.05;
    const double radii = nodes[0].radius + nodes[1].radius;
    if (task.part.level < kFinestLevel && over_.deviation(pair_) > kMostDeviation * radii) return divide_time(task);
    if (link[0].triangle_count > 0 && link[1].triangle_count > 0) return visit_leaves(task, link, nodes);
    const bool splits_first =
        link[1].triangle_count > 0 || (link[0].triangle_count == 0 && nodes[0].radius >= nodes[1].radius);
    const int side = splits_first ? 0 : 1;
    DistanceTask children[kBlockWidth];
    int count = 0;
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const int32_t child = link[side].first * kBlockWidth + slot;
      if (links_[side][child].triangle_count < 0) continue;
      nodes[side] = node_over(pair_, over_, side, child);
      DistanceTask next = task;
      next.node[side] = child;
      next.bound = larger(distance_bound(pair_, over_, nodes, enough(), hint_), task.bound);
      if (is_decided(next.bound)) {
        dismiss(next.bound);
        continue;
      }
      int place = count++;  // the nearest one last
      for (; place > 0 && children[place - 1].bound < next.bound; --place) children[place] = children[place - 1];
      children[place] = next;
    }
    for (int k = 0; k < count; ++k) add(children[k]);
  }

  PGCCD_HD void divide_time(const DistanceTask& task) {
    DistanceTask half[2] = {task, task};
    for (int k = 0; k < 2; ++k) {
      half[k].part = {task.part.level + 1, 2 * task.part.index + k};
      move_to(half[k].part);
      const NodeOver nodes[2] = {node_over(pair_, over_, 0, task.node[0]), node_over(pair_, over_, 1, task.node[1])};
      half[k].bound = larger(distance_bound(pair_, over_, nodes, enough(), hint_), task.bound);
    }
    const int nearer = half[1].bound < half[0].bound ? 1 : 0;
    add(half[1 - nearer]);
    add(half[nearer]);
  }

  PGCCD_HD void load(int side, NodeLink link, LeafOver& leaf) const {
    leaf.count = link.triangle_count;
    leaf.triangles = triangles_[side] + link.first;
    for (int end = 0; end < over_.ends; ++end) {
      for (int k = 0; k < leaf.count; ++k) leaf.at[end][k] = corners(over_.pose[end], side, leaf.triangles[k]);
    }
  }
  PGCCD_HD Corners3 corners(const typename Pair::Pose& pose, int side, const Triangle& triangle) const {
    Corners3 out;
    for (int c = 0; c < 3; ++c) out.x[c] = pair_.vertex(pose, side, triangle.vertex[c]);
    return out;
  }

  // Along a direction: the bend of the gap of points of both leaves, as in `least_between`.
  PGCCD_HD double bend_along(const LeafOver (&leaves)[2], Vec3<double> d) const {
    if (over_.ends == 1) return 0.0;
    return over_.bend_along(pair_, d, [&](int side, int end, Vec3<double> across) {
      double most = -INFINITY;
      for (int k = 0; k < leaves[side].count; ++k) most = larger(most_along(leaves[side].at[end][k], across), most);
      return most - dot(across, Pair::reference_point(over_.pose[end], side));
    });
  }

  // Lower bounds of the distances of pairs of triangles, by their gaps along a unit direction that turns from
  // `directions[0]` to `directions[1]`.
  PGCCD_HD void raise(const LeafOver (&leaves)[2], const Vec3<double> (&directions)[2],
                      double (&bounds)[kMaxLeafTriangles][kMaxLeafTriangles]) const {
    TurningRange most[kMaxLeafTriangles], least[kMaxLeafTriangles];
    for (int k = 0; k < leaves[0].count; ++k) most[k] = most_of(leaves[0], k, directions);
    for (int l = 0; l < leaves[1].count; ++l) least[l] = least_of(leaves[1], l, directions);
    const double bend = larger(bend_along(leaves, directions[0]), bend_along(leaves, directions[1]));
    for (int k = 0; k < leaves[0].count; ++k) {
      for (int l = 0; l < leaves[1].count; ++l) {
        bounds[k][l] = larger(gap_of(most[k], least[l], directions, bend), bounds[k][l]);
      }
    }
  }

  PGCCD_HD void visit_leaves(const DistanceTask& task, const NodeLink (&link)[2], const NodeOver (&nodes)[2]) {
    LeafOver(&leaves)[2] = memory_.leaves;
    load(0, link[0], leaves[0]);
    load(1, link[1], leaves[1]);
    double bounds[kMaxLeafTriangles][kMaxLeafTriangles];
    uint32_t left[kMaxLeafTriangles];  // pairs not looked at
    for (int k = 0; k < leaves[0].count; ++k) {
      left[k] = (1u << leaves[1].count) - 1u;
      for (int l = 0; l < leaves[1].count; ++l) bounds[k][l] = task.bound;
    }
    const Vec3<double> between = unit_vector(nodes[1].centre[0] - nodes[0].centre[0]);
    raise(leaves, {between, between}, bounds);
    raise(leaves, {hint_, hint_}, bounds);
    const bool divides = !pair_.is_still() && task.part.level < kFinestLevel;
    double open = INFINITY;  // least bound of pairs that need shorter parts of the step
    double at = 0.5;
    while (found_.upper > goal_.touching) {
      int first = -1, second = -1;
      double least = INFINITY;
      for (int k = 0; k < leaves[0].count; ++k) {
        for (int l = 0; l < leaves[1].count; ++l) {
          if (!(left[k] >> l & 1u) || !(bounds[k][l] < least)) continue;
          least = bounds[k][l];
          first = k;
          second = l;
        }
      }
      // Both halves look at all pairs again, so one that is open suffices.
      const bool ends = divides && open < INFINITY;
      if (first < 0 || ends || is_decided(least)) {
        if (ends) open = smaller(least, open);
        if (!ends) dismiss(least);
        break;
      }
      left[first] &= ~(1u << second);
      const PairOfTriangles pair{{&leaves[0], &leaves[1]}, {first, second}};
      Vec3<double> directions[2];
      const double bound = larger(look_at(pair, at, directions), least);
      double& least_of_all = is_decided(bound) ? found_.lower : open;
      least_of_all = smaller(bound, least_of_all);
      raise(leaves, directions, bounds);
    }
    if (!(open < INFINITY)) return;
    if (!divides) return dismiss(open);
    const int nearer = at < 0.5 ? 0 : 1;
    for (const int k : {1 - nearer, nearer}) {
      DistanceTask half = task;
      half.part = {task.part.level + 1, 2 * task.part.index + k};
      half.bound = open;
      add(half);
    }
  }

  PGCCD_HD TurningRange most_of(const LeafOver& leaf, int place, const Vec3<double> (&d)[2]) const {
    return most_along(leaf.at[0][place], leaf.at[over_.ends - 1][place], d);
  }
  PGCCD_HD TurningRange least_of(const LeafOver& leaf, int place, const Vec3<double> (&d)[2]) const {
    return least_along(leaf.at[0][place], leaf.at[over_.ends - 1][place], d);
  }
  PGCCD_HD double gap_of(const TurningRange& most, const TurningRange& least, const Vec3<double> (&d)[2],
                         double bend) const {
    const double gap = over_.ends == 1 ? least.at[0] - most.at[0] : turning_gap(most, least, d, bend);
    return gap - pair_.rounding();
  }

  struct PairOfTriangles {
    const LeafOver* leaf[2];
    int place[2];

    PGCCD_HD const Corners3& at(int end, int side) const { return leaf[side]->at[end][place[side]]; }
    PGCCD_HD const Triangle& triangle(int side) const { return leaf[side]->triangles[place[side]]; }
    // On the chords, at a fraction of the way.
    PGCCD_HD Corners3 between(int side, double s) const {
      Corners3 out;
      for (int c = 0; c < 3; ++c) out.x[c] = (1.0 - s) * at(0, side).x[c] + s * at(1, side).x[c];
      return out;
    }
  };

  PGCCD_HD double gap_of(const PairOfTriangles& pair, const Vec3<double> (&d)[2]) const {
    const auto bend = [&](Vec3<double> direction) {
      if (over_.ends == 1) return 0.0;
      return over_.bend_along(pair_, direction, [&](int side, int end, Vec3<double> across) {
        return most_along(pair.at(end, side), across) - dot(across, Pair::reference_point(over_.pose[end], side));
      });
    };
    return gap_of(most_of(*pair.leaf[0], pair.place[0], d), least_of(*pair.leaf[1], pair.place[1], d), d,
                  larger(bend(d[0]), bend(d[1])));
  }

  // A lower bound of the distance of two triangles, by the directions of their nearest points at both ends and at one
  // time between them; and perhaps a lower upper bound. `at`: the fraction of the part of the step at which they are
  // nearest, as far as is known; `directions`: those that give the best bound.
  PGCCD_HD double look_at(const PairOfTriangles& pair, double& at, Vec3<double> (&directions)[2]) {
    --work_;
    at = 0.5;
    NearestOfTriangles nearest;
    for (int end = 0; end < over_.ends; ++end) {
      const NearestOfTriangles now = nearest_of_triangles(pair.at(end, 0), pair.at(end, 1));
      directions[end] = unit_vector(now.direction);
      lower_upper_bound(pair.at(end, 0), pair.at(end, 1), now, directions[end], part_.at(end));
      if (!(now.squared < nearest.squared)) continue;
      nearest = now;
      at = end;
    }
    if (over_.ends == 1) directions[1] = directions[0];
    double bound = gap_of(pair, directions);
    if (over_.ends == 1 || is_decided(bound)) return bound;
    // The time at which the nearest points of the nearer end are nearest.
    const auto offset = [&](int end) {
      return nearest.weights[1].of(pair.at(end, 1)) - nearest.weights[0].of(pair.at(end, 0));
    };
    const Vec3<double> start = offset(0), travel = offset(1) - start;
    const double squared = norm_squared(travel);
    const double s = squared > 0.0 ? unit_clamp(-dot(start, travel) / squared) : 0.0;
    if (!(s > 0.0 && s < 1.0)) return bound;
    const NearestOfTriangles now = nearest_of_triangles(pair.between(0, s), pair.between(1, s));
    const Vec3<double> fixed[2] = {unit_vector(now.direction), unit_vector(now.direction)};
    const double its_bound = gap_of(pair, fixed);
    if (its_bound > bound) {
      bound = its_bound;
      directions[0] = directions[1] = fixed[0];
    }
    at = s;
    if (square_root(now.squared) - over_.deviation(pair_) < found_.upper) {
      const auto pose = pair_.pose(part_.at(s));
      lower_upper_bound(corners(pose, 0, pair.triangle(0)), corners(pose, 1, pair.triangle(1)), now, fixed[0],
                        part_.at(s));
    }
    return bound;
  }

  // Lowers the upper bound to the distance of the points at a time, if that is less.
  PGCCD_HD void lower_upper_bound(const Corners3& a, const Corners3& b, const NearestOfTriangles& nearest,
                                  Vec3<double> direction, double t) {
    Vec3<double> points[2] = {nearest.weights[0].of(a), nearest.weights[1].of(b)};
    double upper = norm(points[1] - points[0]) * (1.0 + 0x1p-48) + pair_.rounding();
    // The direction of the nearest points separates triangles, unless they have a common point.
    const bool may_meet = !(gap_along(a, b, direction) > pair_.rounding());
    if (may_meet && certainly_intersect(a, b, pair_.point_error(), points)) upper = 0.0;
    if (!(upper < found_.upper)) return;
    found_.upper = upper;
    found_.time = t;
    found_.point[0] = points[0];
    found_.point[1] = points[1];
    hint_ = direction;
  }

  const Pair& pair_;
  DistanceGoal goal_;
  DistanceMemory& memory_;
  const NodeLink* links_[2];
  const Triangle* triangles_[2];
  PairOver<Pair> over_;
  TimePart part_{0, 0};
  int count_ = 0, work_ = 0;
  double tolerance_ = 0.0;            // of the search in progress
  Vec3<double> hint_{0.0, 0.0, 0.0};  // direction of the nearest points known
  DistanceFound found_{INFINITY, INFINITY, NAN, {{NAN, NAN, NAN}, {NAN, NAN, NAN}}};
};

// One row of the outputs.
template <class Bodies>
PGCCD_HD void find_distance(const Bodies& bodies, const DistanceInput& input, int64_t row, DistanceMemory& memory,
                            const DistanceColumns& out) {
  const int64_t i = input.pairs[2 * row], j = input.pairs[2 * row + 1];
  const MovingPair<Bodies> pair(bodies, i, j);
  const double* const margin = bodies.centres.margin;
  const double at_least = margin == nullptr ? 0.0 : add_down(margin[i], margin[j]);
  const double at_most = pair_separation(bodies.centres, i, j, 0.0);
  const double beyond = std::nextafter(input.cutoff, static_cast<double>(INFINITY));
  const DistanceGoal goal{at_least, at_most, add_up(beyond, at_most),
                          distance_tolerance(bodies.centres, i, j, input.tolerance)};
  const DistanceFound found = DistanceSearch<MovingPair<Bodies>>(pair, goal, memory).run();
  const double lower = larger(add_down(found.lower, -at_most), 0.0);
  const bool has_points = found.upper < INFINITY && !(lower > input.cutoff);
  out.lower[row] = lower;
  out.upper[row] = has_points ? larger(add_up(found.upper, -at_least), 0.0) : INFINITY;
  out.time[row] = has_points ? found.time : NAN;
  for (int side = 0; side < 2; ++side) {
    const Vec3<double> none{NAN, NAN, NAN};
    store_vec3(out.points + 6 * row + 3 * side, has_points ? pair.in_world(found.point[side], found.time) : none);
  }
}

}  // namespace pgccd
