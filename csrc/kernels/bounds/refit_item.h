// Bounds of deforming bodies: the SBV of a step, and spheres of the hierarchy's nodes at both ends of it, with one
// radius. By convexity they bound the nodes at every interpolated time.
#pragma once

#include "kernels/bounds/node_bounds.h"

namespace pgccd {

// The mean of the corner coordinates over all triangles (Du, Liu & Suzumura 2017, Eq. 1) is summed in chunks of this
// many faces, then over the chunks, always in order: bitwise equal for any number of threads.
constexpr int64_t kMeanChunk = 256;

PGCCD_HD Vec3<double> corner_sum(const int32_t* faces, int64_t face_count, int64_t chunk, const double* vertices) {
  Vec3<double> sum{0.0, 0.0, 0.0};
  const int64_t end = smaller((chunk + 1) * kMeanChunk, face_count);
  for (int64_t f = chunk * kMeanChunk; f < end; ++f) {
    for (int corner = 0; corner < 3; ++corner) sum = sum + load_vec3(vertices + 3 * int64_t(faces[3 * f + corner]));
  }
  return sum;
}

PGCCD_HD LocalVertex local_vertex(const BodyShape& shape, int32_t vertex) {
  const Vec3<float> at_t0 = cast<float>(shape.local(0, vertex)), at_t1 = cast<float>(shape.local(1, vertex));
  return {{{at_t0.x, at_t0.y, at_t0.z, 0.0f}, {at_t1.x, at_t1.y, at_t1.z, 0.0f}}};
}

// Number of used slots, which come first. All are read at once.
PGCCD_HD int used_slots(const NodeLink* links, int64_t block) {
  int count = 0;
  for (int slot = 0; slot < kBlockWidth; ++slot) count += links[block * kBlockWidth + slot].triangle_count >= 0;
  return count;
}

PGCCD_HD void store_node(const NodeBounds& node, int end, int slot, NodeBlock& block) {
  block.x[slot] = node.centre[end].x;
  block.y[slot] = node.centre[end].y;
  block.z[slot] = node.centre[end].z;
  block.radius[slot] = static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit);
  block.normal_x[slot] = node.normal.x;
  block.normal_y[slot] = node.normal.y;
  block.normal_z[slot] = node.normal.z;
  // One slab for both ends, widened by more than the rounding of the projections.
  const double slack = 0x1p-22 * node.radius;
  block.low[slot] = static_cast<float>(smaller(node.low[0], node.low[1]) - slack);
  block.high[slot] = static_cast<float>(larger(node.high[0], node.high[1]) + slack);
}

PGCCD_HD void store_empty(int slot, NodeBlock& block) {
  block.x[slot] = block.y[slot] = block.z[slot] = block.radius[slot] = NAN;
  block.normal_x[slot] = block.normal_y[slot] = block.normal_z[slot] = block.low[slot] = block.high[slot] = NAN;
}

// Computes one node from the finished block below it, and stores its spheres at both ends; or stores an empty slot. The
// first thread of the team writes.
template <class Team>
PGCCD_HD void refit_node(const Team& team, const BodyShape& shape, const Triangle* triangles, const NodeLink* links,
                         int64_t block, int slot, NodeBounds* nodes, NodeBlock* at_t0, NodeBlock* at_t1) {
  const int64_t n = block * kBlockWidth + slot;
  const NodeLink link = links[n];
  if (link.triangle_count < 0) {
    if (team.index() != 0) return;
    store_empty(slot, *at_t0);
    store_empty(slot, *at_t1);
    return;
  }
  const NodeBounds node = link.triangle_count > 0
                              ? leaf_bounds(team, shape, triangles, link)
                              : parent_bounds(team, shape, triangles, nodes + int64_t(link.first) * kBlockWidth,
                                              used_slots(links, link.first));
  if (team.index() != 0) return;
  nodes[n] = node;
  store_node(node, 0, slot, *at_t0);
  store_node(node, 1, slot, *at_t1);
}

}  // namespace pgccd
