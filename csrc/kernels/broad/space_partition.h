// Ownership of space by ranks. Every function of a point is monotone along each axis, rounding included: the cell of a
// point in a box is between those of the box's corners, and a box reaches the side of a plane on which one of its
// points lies.
#pragma once

#include <cmath>

#include "kernels/broad/body_volumes.h"

namespace pgccd {

struct Cell {
  int64_t x, y, z;
};

// Equal cells; those at the boundary extend to infinity.
struct CellFrame {
  double lower[3];
  double per_length[3];  // cells per length unit
  int64_t count[3];

  PGCCD_HD int64_t along(int axis, double x) const {
    const double at = std::floor((x - lower[axis]) * per_length[axis]), last = static_cast<double>(count[axis] - 1);
    return at > 0.0 ? static_cast<int64_t>(at < last ? at : last) : 0;  // 0 also for NaN
  }
  PGCCD_HD Cell cell(Vec3<double> point) const { return {along(0, point.x), along(1, point.y), along(2, point.z)}; }
  PGCCD_HD int64_t index(const Cell& cell) const { return (cell.x * count[1] + cell.y) * count[2] + cell.z; }
  PGCCD_HD int64_t cell_count() const { return count[0] * count[1] * count[2]; }
};

// The cells that a box reaches, numbered 0 to count() - 1.
struct CellRange {
  Cell first, extent;

  PGCCD_HD CellRange(const CellFrame& frame, const SweptBox& box) : first(frame.cell(box.lower)) {
    const Cell last = frame.cell(box.upper);
    extent = {last.x - first.x + 1, last.y - first.y + 1, last.z - first.z + 1};
  }
  PGCCD_HD int64_t count() const { return extent.x * extent.y * extent.z; }
  PGCCD_HD Cell operator[](int64_t number) const {
    const int64_t column = number / extent.z;
    return {first.x + column / extent.y, first.y + column % extent.y, first.z + number % extent.z};
  }
};

// A plane of a recursive bisection, as a row of float64 numbers. Its children below and above are a later row of the
// table, or rank r as -1 - r.
struct BisectionPlane {
  double axis, at, below, above;

  PGCCD_HD double coordinate(const Vec3<double>& point) const { return component(point, static_cast<int>(axis)); }
  PGCCD_HD int64_t side_of(const Vec3<double>& point) const {
    return static_cast<int64_t>(coordinate(point) < at ? below : above);
  }
  PGCCD_HD bool reaches_below(const SweptBox& box) const { return !(coordinate(box.lower) >= at); }  // NaN: both
  PGCCD_HD bool reaches_above(const SweptBox& box) const { return !(coordinate(box.upper) < at); }
};

PGCCD_HD bool is_sound(const BisectionPlane& plane, int64_t row, int64_t plane_count, int64_t ranks) {
  for (const double side : {plane.below, plane.above}) {
    // Children are later rows, so that every path ends.
    if (!(side < 0.0 ? side >= -static_cast<double>(ranks) : side > row && side < plane_count)) return false;
    if (side != std::floor(side)) return false;
  }
  return plane.axis == 0.0 || plane.axis == 1.0 || plane.axis == 2.0;
}

// Maximum depth of the tree of planes.
constexpr int kMostPlaneDepth = 64;

// The partition of space as seen by one rank: by cells or by planes.
struct Subdomain {
  CellFrame frame;               // of the world for a partition by cells; else of this rank's part
  const int64_t* owner;          // (cells,) rank of each; null for planes
  const BisectionPlane* planes;  // (plane_count,) the first is the root; without planes rank 0 owns everything
  int64_t plane_count;
  int64_t rank;

  PGCCD_HD int64_t owner_of(const Vec3<double>& point) const {
    if (owner != nullptr) return owner[frame.index(frame.cell(point))];
    int64_t at = plane_count > 0 ? 0 : -1;
    while (at >= 0) at = planes[at].side_of(point);
    return -1 - at;
  }

  // Calls visit(rank) for all ranks whose parts the box reaches, possibly several times, until it returns true. Cells
  // are distributed over `threads`.
  template <class Visit>
  PGCCD_HD bool any_owner(const SweptBox& box, Visit visit, int64_t thread = 0, int64_t threads = 1) const {
    if (owner == nullptr) return thread == 0 && any_bisected(box, visit);
    const CellRange range(frame, box);
    const int64_t count = range.count();
    for (int64_t cell = thread; cell < count; cell += threads) {
      if (visit(owner[frame.index(range[cell])])) return true;
    }
    return false;
  }

  // Whether a cell of `frame` may belong to this rank.
  PGCCD_HD bool has_cell(int64_t cell) const { return owner == nullptr || owner[cell] == rank; }

 private:
  template <class Visit>
  PGCCD_HD bool any_bisected(const SweptBox& box, Visit visit) const {
    int64_t stack[kMostPlaneDepth];
    int size = 0;
    int64_t at = plane_count > 0 ? 0 : -1;
    for (;;) {
      while (at >= 0) {
        const BisectionPlane& plane = planes[at];
        const auto below = static_cast<int64_t>(plane.below), above = static_cast<int64_t>(plane.above);
        if (!plane.reaches_below(box)) {
          at = above;
        } else {
          if (plane.reaches_above(box)) stack[size++] = above;
          at = below;
        }
      }
      if (visit(-1 - at)) return true;
      if (size == 0) return false;
      at = stack[--size];
    }
  }
};

}  // namespace pgccd
