// Grid broad phase: levels and cells.
//
// Levels (hierarchical grid, Ericson 2005, Real-Time Collision Detection, 7.2): the cell size doubles from level to
// level. A body belongs to the first level where its swept box spans at most two cells per axis, and is stored in the
// cell of its lower corner. So overlapping bodies of one level are in neighbouring cells, and a body is tested in its
// own level (the later half of the neighbours) and in coarser ones, never in finer ones: a body as large as the scene
// is found by each of the others.
#pragma once

#include "core/bits.h"
#include "kernels/broad/body_volumes.h"

namespace pgccd {

// Origin and number of level-0 cells per length unit, on each axis.
struct GridFrame {
  double origin[3];
  double scale[3];
};

// Corners of a swept box in cells of level 0. Monotone in the position, which suffices for correctness: with any
// rounding, boxes that overlap have overlapping spans.
struct GridSpan {
  int64_t lower[3], upper[3];
};

PGCCD_HD int64_t grid_coordinate(double x, double origin, double scale) {
  constexpr double kLimit = 0x1p61;  // so that differences do not overflow
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

// The first level whose cells are as large as the span: a span then covers at most two cells.
PGCCD_HD uint32_t grid_level(const GridSpan& span) {
  int64_t longest = 1;
  for (int k = 0; k < 3; ++k) longest = larger(longest, span.upper[k] - span.lower[k]);
  return static_cast<uint32_t>(bit_width(static_cast<uint64_t>(longest - 1)));
}

// Only the low bits of coordinates are compared: cells 2^20 apart count as equal, which costs tests but does not change
// the result.
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

// The cell in a coarser level, from the cell itself. The shift loses upper bits; none that are compared if the level is
// at most kCoarserLevels above.
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
