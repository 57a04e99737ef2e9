#include "mesh/node_support.h"

#include <cmath>

#include "mesh/point_columns.h"

namespace pgccd {
namespace {

constexpr int kSamples = kSupportFaces * (kSupportCells + 1) * (kSupportCells + 1);
constexpr int kSampleRows = kSamples / static_cast<int>(kDoubleLanes);
static_assert(kSupportCells + 1 == kDoubleLanes);

// Directions of one row of samples: a row of `NodeSupport`.
struct Directions {
  Double4 along[3];
};

using Int4 = int32_t __attribute__((vector_size(16)));
using Samples = std::array<Double4, kSampleRows>;

std::array<Directions, kSampleRows> make_directions() {
  std::array<Directions, kSampleRows> out;
  for (int row = 0; row < kSampleRows; ++row) {
    const int face = row / (kSupportCells + 1), p = row % (kSupportCells + 1), axis = face / 2;
    const auto coordinate = [](int k) { return k / (0.5 * kSupportCells) - 1.0; };
    out[row].along[axis] = Double4{} + (face % 2 == 0 ? 1.0 : -1.0);
    out[row].along[(axis + 1) % 3] = Double4{} + coordinate(p);
    out[row].along[(axis + 2) % 3] = Double4{coordinate(0), coordinate(1), coordinate(2), coordinate(3)};
  }
  return out;
}
const std::array<Directions, kSampleRows> kDirections = make_directions();

Double4 projections(const Directions& d, Vec3<double> point) {
  return multiply_add(Double4{} + point.z, d.along[2],
                      multiply_add(Double4{} + point.y, d.along[1], point.x * d.along[0]));
}

void include(Samples& samples, const Samples& others) {
  for (int row = 0; row < kSampleRows; ++row) samples[row] = larger(samples[row], others[row]);
}

// Largest projections of a leaf's vertices.
Samples sample_leaf(const Hierarchy& tree, const NodeLink& leaf, const double* vertices) {
  Samples out;
  out.fill(Double4{} - HUGE_VAL);
  for (int32_t row = leaf.first_points; row < leaf.first_points + leaf.points_count; ++row) {
    const LeafPoints& points = tree.leaf_points[row];
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      if (slot > 0 && points.vertex[slot] == points.vertex[slot - 1]) break;  // unused slots
      const Vec3<double> point = load_vec3(vertices + 3 * int64_t{points.vertex[slot]});
      for (int k = 0; k < kSampleRows; ++k) out[k] = larger(out[k], projections(kDirections[k], point));
    }
  }
  return out;
}

// Relative to the node's centre, rounded up to whole steps.
NodeSupport rounded_up(const Samples& samples, Vec3<double> centre, double radius) {
  // More than the rounding of both projections and of the number of steps.
  const double slack = 1e-14 * (std::abs(centre.x) + std::abs(centre.y) + std::abs(centre.z) + radius);
  const double steps_a_length = 1.0 / (radius * double{kSupportStep});
  const Double4 none{}, most = none + 255.0;  // all vertices are within the radius, hence within 255 steps
  NodeSupport out;
  for (int row = 0; row < kSampleRows; ++row) {
    const Double4 support = samples[row] - projections(kDirections[row], centre) + slack;
    Double4 steps = smaller(larger(steps_a_length * support, none), most);
    for (int q = 0; q < kDoubleLanes; ++q) steps[q] = std::ceil(steps[q]);
    const Int4 bytes = __builtin_convertvector(steps, Int4);
    out.rows[row / (kSupportCells + 1)][row % (kSupportCells + 1)] =
        bytes[0] | bytes[1] << 8 | bytes[2] << 16 | bytes[3] << 24;
  }
  return out;
}

}  // namespace

std::vector<std::array<NodeSupport, kBlockWidth>> sample_supports(const Hierarchy& tree, const double* vertices) {
  std::vector<std::array<NodeSupport, kBlockWidth>> out(tree.blocks.size());
  std::vector<Samples> of_block(tree.blocks.size());  // of all nodes of a block
  for (size_t k = tree.blocks.size(); k-- > 0;) {     // blocks of children follow those of their parents
    const NodeBlock& block = tree.blocks[k];
    of_block[k].fill(Double4{} - HUGE_VAL);
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const NodeLink& link = tree.links[k][slot];
      if (link.triangle_count < 0) continue;
      const Samples samples = link.triangle_count > 0 ? sample_leaf(tree, link, vertices) : of_block[link.first];
      const Vec3<double> centre{block.x[slot], block.y[slot], block.z[slot]};
      out[k][slot] = rounded_up(samples, centre, block.radius[slot]);
      include(of_block[k], samples);
    }
  }
  return out;
}

}  // namespace pgccd
