// Grid broad phase: levels and cells.
//
// Levels (hierarchical grid, Ericson 2005, Real-Time Collision Detection, 7.2): cells double in size from level to
// level. A body belongs to the first level where its swept box spans at most two cells an axis, and lies in the cell of
// its lower corner. So bodies of one level that meet lie in neighbouring cells, and partners of a body are searched for
// in its own level (in the half of the neighbours that comes later) and in coarser ones, never in finer ones: a body as
// large as the scene is found by the others, each for itself.
#pragma once

#include "core/bits.h"
#include "kernels/broad/body_volumes.h"

namespace pgccd {

// Where coordinates start and how many cells of level 0 a length is, on each axis.
struct GridFrame {
  double origin[3];
  double scale[3];
};

// Corners of a swept box in cells of level 0. Monotone in the position, which is all that correctness needs: however
// coordinates are rounded, boxes that overlap have overlapping spans.
struct GridSpan {
  int64_t lower[3], upper[3];
};

PGCCD_HD int64_t grid_coordinate(double x, double origin, double scale) {
  constexpr double kLimit = 0x1p61;  // so that differences fit
  return static_cast<int64_t>(std::floor(larger(-kLimit, smaller((x - origin) * scale, kLimit))));
}

PGCCD_HD GridSpan grid_span(const GridFrame& frame, const SweptBox& box) {
  GridSpan span;
  for (int k = 0; k < 3; ++k) {
    span.lower[k] = grid_coordinate(component(box.lower, k), frame.origin[k], frame.scale[k]);
    span.upper[k] = grid_coordinate(component(box.upper, k), frame.origin[k], frame.scale[k]);
  }
  return span;
}

constexpr uint32_t kGridLevels = 63;

// The first level whose cells are as large as the span; two intervals of one cell's length share an end at least.
PGCCD_HD uint32_t grid_level(const GridSpan& span) {
  int64_t longest = 1;
  for (int k = 0; k < 3; ++k) longest = larger(longest, span.upper[k] - span.lower[k]);
  return static_cast<uint32_t>(bit_width(static_cast<uint64_t>(longest - 1)));
}

// Only the low bits of coordinates are looked at: cells 2^20 apart are taken for one another, which costs tests and
// changes nothing.
constexpr int kCoordinateBits = 20;
PGCCD_HD uint32_t low_bits(uint32_t coordinate) { return coordinate & ((1u << kCoordinateBits) - 1u); }

struct alignas(16) GridCell {
  uint32_t lower[3];         // modulo 2^32
  uint32_t level_and_reach;  // level + 2^8 (reach_x + 2 reach_y + 4 reach_z)

  PGCCD_HD uint32_t level() const { return level_and_reach & 0xffu; }
  // 1 if the box reaches into the next cell.
  PGCCD_HD uint32_t reach(int axis) const { return (level_and_reach >> (8 + axis)) & 1u; }
};

PGCCD_HD GridCell grid_cell(const GridSpan& span, uint32_t level) {
  GridCell cell;
  uint32_t reach = 0;
  for (int k = 0; k < 3; ++k) {
    cell.lower[k] = static_cast<uint32_t>(span.lower[k] >> level);
    reach |= (static_cast<uint32_t>(span.upper[k] >> level) - cell.lower[k]) << k;
  }
  cell.level_and_reach = level | (reach << 8);
  return cell;
}

// The same in a coarser level, from the cell itself. Bits get lost at the upper end: none that are looked at if the
// level is at most kCoarserLevels above.
constexpr uint32_t kCoarserLevels = 32 - kCoordinateBits - 1;
PGCCD_HD GridCell coarser_cell(const GridCell& cell, uint32_t level) {
  GridCell coarser;
  const uint32_t shift = level - cell.level();
  uint32_t reach = 0;
  for (int k = 0; k < 3; ++k) {
    coarser.lower[k] = cell.lower[k] >> shift;
    reach |= ((((cell.lower[k] + cell.reach(k)) >> shift) - coarser.lower[k]) & 1u) << k;
  }
  coarser.level_and_reach = level | (reach << 8);
  return coarser;
}

}  // namespace pgccd
