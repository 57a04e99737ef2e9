// Grid broad phase: the bodies of each cell, and the cells that may contain partners of a body.
//
// Cells are hashed, so that memory is proportional to the number of bodies, whatever their positions. Each level has
// its own table. The low bits of a cell's coordinates are its place in a tile as large as the table; the tile and the
// world only shift that place. In a scene within one tile there are no collisions of hashes, and cells adjacent along x
// are adjacent in the table.
#pragma once

#include "kernels/broad/grid_item.h"

namespace pgccd {

// Cells [x_first, x_last] of one row, and their buckets.
struct GridRun {
  uint32_t x_first, x_last, y, z;
  uint32_t first_bucket, last_bucket;
  bool starts_at_home;  // in the cell of the body itself

  // True if the run contains a cell of the same level.
  PGCCD_HD bool contains(const GridCell& cell) const {
    return low_bits(cell.lower[1]) == low_bits(y) && low_bits(cell.lower[2]) == low_bits(z) &&
           low_bits(cell.lower[0] - x_first) <= x_last - x_first;
  }
};

class GridTable {
 public:
  int bits[3];  // bits of the tile on each axis; at least 2, so that a cell's neighbours in a tile are distinct
  uint32_t begin;

  PGCCD_HD uint32_t bucket(const GridCell& cell, uint32_t world) const {
    const uint32_t x = cell.lower[0], y = cell.lower[1], z = cell.lower[2];
    return bucket(x, y, z, salt(x, y, z, world));
  }

  // True if the cell and all its neighbours are in one tile. Then each has a bucket of its own; else several may share
  // one, and the cell of each body found must be compared.
  PGCCD_HD bool in_one_tile(const GridCell& cell) const {
    bool inside = true;
    for (int k = 0; k < 3; ++k) inside &= tile(cell.lower[k] - 1u, k) == tile(cell.lower[k] + 1u, k);
    return inside;
  }

  // Visits the runs of cells that may contain partners of a body whose box starts in `cell`, each cell once. With
  // kLater, only cells after it in the order of (z, y, x), and itself, as the first cell of the first run.
  template <bool kLater, class Visit>
  PGCCD_HD void visit_runs(const GridCell& cell, uint32_t world, Visit&& visit) const {
    const uint32_t last_of_tile = (1u << bits[0]) - 1u;
    visit_rows<kLater>(cell, [&](uint32_t first, uint32_t last, uint32_t y, uint32_t z, bool at_home) {
      for (bool ends = false; !ends; first = (first | last_of_tile) + 1u) {
        ends = tile(first, 0) == tile(last, 0);
        const uint32_t stop = ends ? last : first | last_of_tile;
        const uint32_t first_bucket = bucket(first, y, z, salt(first, y, z, world));
        visit(GridRun{first, stop, y, z, first_bucket, first_bucket + (stop - first), at_home});
        at_home = false;
      }
    });
  }

  // As visit_runs, for a cell `in_one_tile`.
  template <bool kLater, class Visit>
  PGCCD_HD void visit_runs_in_tile(const GridCell& cell, uint32_t world, Visit&& visit) const {
    const uint32_t own_salt = salt(cell.lower[0], cell.lower[1], cell.lower[2], world);
    visit_rows<kLater>(cell, [&](uint32_t first, uint32_t last, uint32_t y, uint32_t z, bool at_home) {
      const uint32_t first_bucket = bucket(first, y, z, own_salt);
      visit(GridRun{first, last, y, z, first_bucket, first_bucket + (last - first), at_home});
    });
  }

 private:
  PGCCD_HD uint32_t tile(uint32_t coordinate, int axis) const { return low_bits(coordinate) >> bits[axis]; }

  PGCCD_HD uint32_t salt(uint32_t x, uint32_t y, uint32_t z, uint32_t world) const {
    uint32_t hash = tile(x, 0) * 0x9e3779b1u ^ tile(y, 1) * 0x85ebca77u ^ tile(z, 2) * 0xc2b2ae3du;
    hash ^= world * 0x165667b1u;
    hash = (hash ^ (hash >> 15)) * 0x2c1b3c6du;  // so that consecutive tiles are not consecutive in the table
    return hash ^ (hash >> 13);
  }

  PGCCD_HD uint32_t bucket(uint32_t x, uint32_t y, uint32_t z, uint32_t salt) const {
    const uint32_t row = ((z << bits[1]) | (y & ((1u << bits[1]) - 1u))) + salt;
    return begin + (((row & ((1u << (bits[1] + bits[2])) - 1u)) << bits[0]) | (x & ((1u << bits[0]) - 1u)));
  }

  // visit(x_first, x_last, y, z, at_home)
  template <bool kLater, class Visit>
  PGCCD_HD static void visit_rows(const GridCell& cell, Visit&& visit) {
    const uint32_t x = cell.lower[0], y = cell.lower[1], z = cell.lower[2];
    const uint32_t x_last = x + cell.reach(0);
    if (kLater) {
      visit(x, x_last, y, z, true);
      if (cell.reach(1)) visit(x - 1u, x_last, y + 1u, z, false);
      if (!cell.reach(2)) return;
    }
    for (uint32_t layer = kLater ? z + 1u : z - 1u; layer != z + cell.reach(2) + 1u; ++layer)
      for (uint32_t row = y - 1u; row != y + cell.reach(1) + 1u; ++row) visit(x - 1u, x_last, row, layer, false);
  }
};

struct GridTables {
  GridTable of_level[kGridLevels];
  uint64_t levels;  // bit set of levels with bodies
};

// The levels of a bit set that are coarser than `level`.
PGCCD_HD uint64_t coarser_levels(uint64_t levels, uint32_t level) { return levels >> level >> 1 << level << 1; }

constexpr int kFewestBucketBits = 6, kMostBucketBits = 30;
// Two to four buckets per body, over all levels.
PGCCD_HD int bucket_bits(int64_t body_count) {
  return smaller(bit_width(static_cast<uint64_t>(2 * body_count)), kMostBucketBits);
}
// An upper bound of the buckets that `divide_buckets` assigns.
PGCCD_HD int64_t most_buckets(int64_t body_count) {
  return (int64_t{4} << bucket_bits(body_count)) / 3 + (kGridLevels << kFewestBucketBits);
}

// Assigns each level its share, a power of two.
PGCCD_HD void divide_buckets(const uint32_t (&level_counts)[kGridLevels], int64_t body_count, GridTables& tables) {
  const double all = static_cast<double>(int64_t{1} << bucket_bits(body_count));
  tables.levels = 0;
  uint32_t begin = 0;
  for (uint32_t level = 0; level < kGridLevels; ++level) {
    if (level_counts[level] == 0) continue;
    const double share = all * static_cast<double>(level_counts[level]) / static_cast<double>(body_count);
    // Rounded up from three quarters of a power of two: the tables exceed the shares by at most a third.
    int bits = kFewestBucketBits;
    while (0.75 * static_cast<double>(int64_t{2} << bits) <= share) ++bits;
    tables.of_level[level] = {{(bits + 2) / 3, (bits + 1) / 3, bits / 3}, begin};
    tables.levels |= uint64_t{1} << level;
    begin += 1u << bits;
  }
}

}  // namespace pgccd
