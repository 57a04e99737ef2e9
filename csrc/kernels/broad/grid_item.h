// Grid broad phase: cells, the hash table of cells, and the cells that one body must look into.
//
// Levels (hierarchical grid, Ericson 2005, Real-Time Collision Detection, 7.2): cells double in size from level to
// level. A body belongs to the first level where its swept box spans at most two cells an axis, and lies in the cell of
// its lower corner. So bodies of one level that meet lie in neighbouring cells, and a body looks for partners in its
// own level (in the half of the neighbours that comes later) and in coarser ones, never in finer ones: a body as large
// as the scene is found by the others, each for itself.
//
// Cells are hashed, so that memory is proportional to the bodies, wherever they are. The low bits of a cell's
// coordinates keep its place in a tile as large as the table; the tile, the level and the world only shift that place.
// In a scene that one tile holds, nothing collides; cells next to one another along x are so in the table as well.
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

// Cells [x_first, x_last] of one row, and their buckets.
struct GridRun {
  uint32_t level, x_first, x_last, y, z;
  uint32_t first_bucket, last_bucket;

  PGCCD_HD bool contains(const GridCell& cell) const {
    return cell.level() == level && low_bits(cell.lower[1]) == low_bits(y) && low_bits(cell.lower[2]) == low_bits(z) &&
           low_bits(cell.lower[0] - x_first) <= x_last - x_first;
  }
  PGCCD_HD bool starts_with(const GridCell& cell) const {
    return cell.level() == level && cell.lower[0] == x_first && cell.lower[1] == y && cell.lower[2] == z;
  }
};

class GridTable {
 public:
  int bits[3];  // of the tile on each axis; at least 2, so that a cell's neighbours in a tile are distinct

  PGCCD_HD int64_t bucket_count() const { return int64_t{1} << (bits[0] + bits[1] + bits[2]); }

  PGCCD_HD uint32_t bucket(const GridCell& cell, uint32_t world) const {
    return bucket(cell.lower[0], cell.lower[1], cell.lower[2],
                  salt(cell.lower[0], cell.lower[1], cell.lower[2], cell.level(), world));
  }

  // Do the cell and all its neighbours lie in one tile?
  PGCCD_HD bool in_one_tile(const GridCell& cell) const {
    bool inside = true;
    for (int k = 0; k < 3; ++k) inside &= tile(cell.lower[k] - 1u, k) == tile(cell.lower[k] + 1u, k);
    return inside;
  }

  // The runs of cells of one level in which partners of a body may lie whose box starts in `cell`; each cell once. If
  // kLater, only those that come after it in the order of (z, y, x), and itself, the first cell of the first run.
  // Buckets may be shared by different cells: what is found there must be asked for its cell.
  template <bool kLater, class Visit>
  PGCCD_HD void visit_runs(const GridCell& cell, uint32_t world, Visit&& visit) const {
    const uint32_t level = cell.level(), last_of_tile = (1u << bits[0]) - 1u;
    visit_rows<kLater>(cell, [&](uint32_t first, uint32_t last, uint32_t y, uint32_t z) {
      for (bool ends = false; !ends; first = (first | last_of_tile) + 1u) {
        ends = tile(first, 0) == tile(last, 0);
        const uint32_t stop = ends ? last : first | last_of_tile;
        const uint32_t begin = bucket(first, y, z, salt(first, y, z, level, world));
        visit(GridRun{level, first, stop, y, z, begin, begin + (stop - first)});
      }
    });
  }

  // The same for a cell `in_one_tile`: these cells have buckets of their own.
  template <bool kLater, class Visit>
  PGCCD_HD void visit_runs_in_tile(const GridCell& cell, uint32_t world, Visit&& visit) const {
    const uint32_t level = cell.level();
    const uint32_t own_salt = salt(cell.lower[0], cell.lower[1], cell.lower[2], level, world);
    visit_rows<kLater>(cell, [&](uint32_t first, uint32_t last, uint32_t y, uint32_t z) {
      const uint32_t begin = bucket(first, y, z, own_salt);
      visit(GridRun{level, first, last, y, z, begin, begin + (last - first)});
    });
  }

 private:
  PGCCD_HD uint32_t tile(uint32_t coordinate, int axis) const { return low_bits(coordinate) >> bits[axis]; }

  PGCCD_HD uint32_t salt(uint32_t x, uint32_t y, uint32_t z, uint32_t level, uint32_t world) const {
    uint32_t hash = tile(x, 0) * 0x9e3779b1u ^ tile(y, 1) * 0x85ebca77u ^ tile(z, 2) * 0xc2b2ae3du;
    hash ^= level * 0x27d4eb2fu ^ world * 0x165667b1u;
    hash = (hash ^ (hash >> 15)) * 0x2c1b3c6du;  // so that tiles in a row do not end up in a row
    return hash ^ (hash >> 13);
  }

  PGCCD_HD uint32_t bucket(uint32_t x, uint32_t y, uint32_t z, uint32_t salt) const {
    const uint32_t row = ((z << bits[1]) | (y & ((1u << bits[1]) - 1u))) + salt;
    return ((row & ((1u << (bits[1] + bits[2])) - 1u)) << bits[0]) | (x & ((1u << bits[0]) - 1u));
  }

  // visit(x_first, x_last, y, z)
  template <bool kLater, class Visit>
  PGCCD_HD static void visit_rows(const GridCell& cell, Visit&& visit) {
    const uint32_t x = cell.lower[0], y = cell.lower[1], z = cell.lower[2];
    const uint32_t x_last = x + cell.reach(0);
    if (kLater) {
      visit(x, x_last, y, z);
      if (cell.reach(1)) visit(x - 1u, x_last, y + 1u, z);
      if (!cell.reach(2)) return;
    }
    for (uint32_t layer = kLater ? z + 1u : z - 1u; layer != z + cell.reach(2) + 1u; ++layer)
      for (uint32_t row = y - 1u; row != y + cell.reach(1) + 1u; ++row) visit(x - 1u, x_last, row, layer);
  }
};

// Two to four buckets a body.
PGCCD_HD GridTable grid_table(int64_t body_count) {
  constexpr int kFewestBits = 9, kMostBits = 30;
  int bits = bit_width(static_cast<uint64_t>(2 * body_count));
  bits = bits < kFewestBits ? kFewestBits : smaller(bits, kMostBits);
  return {{(bits + 2) / 3, (bits + 1) / 3, bits / 3}};
}

}  // namespace pgccd
