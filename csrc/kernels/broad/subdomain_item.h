// The box of a body, and the parts of space that it reaches.
#pragma once

#include "core/paths.h"
#include "kernels/broad/space_partition.h"

namespace pgccd {

PGCCD_HD void store_swept_box(const BroadBodies& bodies, int64_t body, double* lower, double* upper) {
  const SweptBox box = swept_box(bodies, body);
  lower[3 * body] = box.lower.x;
  lower[3 * body + 1] = box.lower.y;
  lower[3 * body + 2] = box.lower.z;
  upper[3 * body] = box.upper.x;
  upper[3 * body + 1] = box.upper.y;
  upper[3 * body + 2] = box.upper.z;
}

PGCCD_HD bool reaches_others(const BroadBodies& bodies, const Subdomain& subdomain, int64_t body) {
  if (bodies.is_absent(body)) return false;
  return subdomain.any_owner(swept_box(bodies, body), [&](int64_t rank) { return rank != subdomain.rank; });
}

// Writes the other ranks whose parts a body reaches, possibly repeated, to `out` unless it is null. Returns their
// number.
PGCCD_HD int64_t store_reached(const BroadBodies& bodies, const Subdomain& subdomain, int64_t body, int64_t* out) {
  int64_t count = 0, last = subdomain.rank;
  subdomain.any_owner(swept_box(bodies, body), [&](int64_t rank) {
    if (rank != subdomain.rank && rank != last) {
      if (out != nullptr) out[count] = rank;
      ++count;
    }
    last = rank;
    return false;
  });
  return count;
}

// Pairs of some of the held bodies, which are numbered with own ones first, then ghosts.
struct OwnedPairs {
  BroadBodies bodies;
  Subdomain subdomain;
  const int64_t* rows;   // (bodies.count,) index of each among the held bodies
  const uint8_t* reach;  // (own_count,) bits
  int64_t own_count;     // of bodies held
  const int64_t* id;     // (held_count,) of bodies held
  int64_t held_count;
  const int64_t* pairs;  // (pair_count, 2) of `bodies`, padding negative
  int64_t pair_count;

  PGCCD_HD int64_t held(int64_t body) const { return rows[body]; }
};

// True for padding, or for a pair of valid bodies.
PGCCD_HD bool is_sound(const OwnedPairs& input, int64_t k) {
  if (input.pairs[2 * k] < 0) return true;
  for (int side = 0; side < 2; ++side) {
    const int64_t body = input.pairs[2 * k + side];
    if (!is_within(body, input.bodies.count) || !is_within(input.held(body), input.held_count)) return false;
  }
  return true;
}

// The reference point of two overlapping boxes is the lower corner of their intersection. It lies in both, so it is
// certainly in a cell of this rank if one of them reaches no other rank. Such pairs of two own bodies are not selected,
// since the search among own bodies has them; it also has the bodies tested against themselves.
PGCCD_HD bool is_owned(const OwnedPairs& input, int64_t k) {
  const int64_t i = input.pairs[2 * k], j = input.pairs[2 * k + 1];
  if (i < 0) return false;
  const int64_t held_i = input.held(i), held_j = input.held(j);
  const bool own_i = held_i < input.own_count, own_j = held_j < input.own_count;
  const bool only_here_i = own_i && input.reach[held_i] == 0, only_here_j = own_j && input.reach[held_j] == 0;
  if (only_here_i || only_here_j) return !(own_i && own_j);
  const Vec3<double> a = swept_box(input.bodies, i).lower, b = swept_box(input.bodies, j).lower;
  const Vec3<double> reference{larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)};
  return input.subdomain.owner_of(reference) == input.subdomain.rank;
}

// Stores the k-th owned pair, the smaller id first; `found` (found_count,) are the indices of all.
PGCCD_HD void store_owned_pair(const OwnedPairs& input, const int64_t* found, int64_t found_count, int64_t k,
                               int64_t* out) {
  if (k >= found_count) {
    out[2 * k] = out[2 * k + 1] = -1;
    return;
  }
  const int64_t i = input.pairs[2 * found[k]], j = input.pairs[2 * found[k] + 1];
  const bool in_order = input.id[input.held(i)] < input.id[input.held(j)];
  out[2 * k] = in_order ? i : j;
  out[2 * k + 1] = in_order ? j : i;
}

// Integers with the same order as the doubles, for device atomics.
PGCCD_HD int64_t ordered(double x) {
  union {
    double number;
    int64_t bits;
  } value{x + 0.0};  // both zeros become equal
  return value.bits >= 0 ? value.bits : value.bits ^ INT64_MAX;
}

// Boxes around all ghosts in each cell: rows of 6, lower and upper corners by `ordered`. So that the table does not
// grow with the world, cells kMostCellsAlong apart share a row: a box around the ghosts in all of them only selects
// more bodies.
constexpr int64_t kMostCellsAlong = 64;
constexpr int64_t kEmptyLower = INT64_MAX, kEmptyUpper = INT64_MIN;

struct CellRows {
  int64_t count[3];

  explicit PGCCD_HD CellRows(const CellFrame& frame) {
    for (int axis = 0; axis < 3; ++axis) count[axis] = smaller(frame.count[axis], kMostCellsAlong);
  }
  PGCCD_HD int64_t size() const { return count[0] * count[1] * count[2]; }
  PGCCD_HD int64_t row(const Cell& cell) const {
    return (cell.x % count[0] * count[1] + cell.y % count[1]) * count[2] + cell.z % count[2];
  }
};

PGCCD_HD void ordered_corners(const SweptBox& box, int64_t (&corners)[6]) {
  for (int axis = 0; axis < 3; ++axis) {
    corners[axis] = ordered(component(box.lower, axis));
    corners[3 + axis] = ordered(component(box.upper, axis));
  }
}

// Whether a body overlaps the box of ghosts in a cell that it reaches, or reaches other ranks.
PGCCD_HD bool is_near(const BroadBodies& bodies, const uint8_t* reach, const CellFrame& frame,
                      const int64_t* cell_boxes, int64_t body) {
  if (bodies.is_absent(body)) return false;
  if (reach[body] != 0) return true;
  const SweptBox box = swept_box(bodies, body);
  const CellRange range(frame, box);
  const CellRows rows(frame);
  int64_t corners[6];
  ordered_corners(box, corners);
  const int64_t count = range.count();
  for (int64_t k = 0; k < count; ++k) {
    const int64_t* around = cell_boxes + 6 * rows.row(range[k]);
    bool meets = true;
    for (int axis = 0; axis < 3; ++axis) {
      meets = meets && corners[axis] <= around[3 + axis] && corners[3 + axis] >= around[axis];
    }
    if (meets) return true;
  }
  return false;
}

struct BodyPositions {
  const double* position;  // (count, 3)
  const int64_t* id;       // (count,) negative for padding; null: there is no padding
  int64_t count;
};

PGCCD_HD int64_t owner_of(const Subdomain& subdomain, const BodyPositions& bodies, int64_t body) {
  return subdomain.owner_of(load_vec3(bodies.position + 3 * body));
}

PGCCD_HD bool is_body(const BodyPositions& bodies, int64_t row) { return bodies.id == nullptr || bodies.id[row] >= 0; }

PGCCD_HD bool is_leaving(const Subdomain& subdomain, const BodyPositions& bodies, int64_t body) {
  return is_body(bodies, body) && owner_of(subdomain, bodies, body) != subdomain.rank;
}

PGCCD_HD bool has_invalid_position(const BodyPositions& bodies, int64_t body) {
  const Vec3<double> position = load_vec3(bodies.position + 3 * body);
  const bool is_valid = std::fabs(position.x) <= kLargestCoordinate && std::fabs(position.y) <= kLargestCoordinate &&
                        std::fabs(position.z) <= kLargestCoordinate;
  return is_body(bodies, body) && !is_valid;  // NaN is invalid
}

}  // namespace pgccd
