#include "mesh/order_in_space.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "mesh/point_columns.h"

namespace pgccd {
namespace {

constexpr int kBits = 14;  // an axis
// Rows are read in no order: so many ahead of their use.
constexpr size_t kAhead = 24;

// Interleaves the bits of three numbers below 2^21.
uint64_t morton_code(const std::array<uint32_t, 3>& cell) {
  uint64_t code = 0;
  for (int axis = 0; axis < 3; ++axis) {
    uint64_t x = cell[axis];
    x = (x | x << 32) & 0x1f00000000ffff;
    x = (x | x << 16) & 0x1f0000ff0000ff;
    x = (x | x << 8) & 0x100f00f00f00f00f;
    x = (x | x << 4) & 0x10c30c30c30c30c3;
    x = (x | x << 2) & 0x1249249249249249;
    code |= x << axis;
  }
  return code;
}

// Faces in the order of their kinds, then along a curve through space (Morton 1966).
std::vector<int32_t> along_curve(const double* vertices, const std::vector<Face>& faces) {
  Double4 low{HUGE_VAL, HUGE_VAL, HUGE_VAL, 0.0}, high = -low;
  const auto first = [&](const Face& face) {
    const double* const p = vertices + 3 * int64_t{face[0]};
    return Double4{p[0], p[1], p[2], 0.0};
  };
  for (const Face& face : faces) {
    const Double4 point = first(face);
    low = point < low ? point : low;
    high = high < point ? point : high;
  }
  const Double4 extent = high - low;
  const double largest = std::max({extent[0], extent[1], extent[2]});
  const double scale = largest > 0.0 ? ((1 << kBits) - 0.5) / largest : 0.0;
  std::vector<std::pair<uint64_t, int32_t>> keys(faces.size());
  for (size_t f = 0; f < faces.size(); ++f) {
    const Double4 at = (first(faces[f]) - low) * scale;
    const std::array<uint32_t, 3> cell{static_cast<uint32_t>(at[0]), static_cast<uint32_t>(at[1]),
                                       static_cast<uint32_t>(at[2])};
    const auto kind = static_cast<uint64_t>(kind_of(faces[f]));
    keys[f] = {kind << 3 * kBits | morton_code(cell), static_cast<int32_t>(f)};
  }
  // A radix sort: keys are many.
  constexpr int kDigit = 11;
  std::vector<std::pair<uint64_t, int32_t>> sorted(keys.size());
  for (int shift = 0; shift < 3 * kBits + 2; shift += kDigit) {
    std::array<size_t, (1 << kDigit) + 1> begin{};
    const auto digit = [shift](uint64_t key) { return key >> shift & ((1 << kDigit) - 1); };
    for (const auto& [key, f] : keys) ++begin[digit(key) + 1];
    for (int d = 0; d < 1 << kDigit; ++d) begin[d + 1] += begin[d];
    for (const auto& row : keys) sorted[begin[digit(row.first)]++] = row;
    keys.swap(sorted);
  }
  std::vector<int32_t> order(faces.size());
  for (size_t k = 0; k < keys.size(); ++k) order[k] = keys[k].second;
  return order;
}

}  // namespace

MeshInSpace order_in_space(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces) {
  MeshInSpace mesh;
  mesh.face_of = along_curve(vertices, faces);
  mesh.faces.resize(faces.size());
  mesh.vertices.reserve(3 * static_cast<size_t>(vertex_count));
  mesh.vertex_of.reserve(static_cast<size_t>(vertex_count));
  std::vector<int32_t> number(static_cast<size_t>(vertex_count), -1);
  for (size_t k = 0; k < faces.size(); ++k) {
    if (k + 2 * kAhead < faces.size()) __builtin_prefetch(&faces[mesh.face_of[k + 2 * kAhead]]);
    if (k + kAhead < faces.size()) {
      const int32_t v = faces[mesh.face_of[k + kAhead]][0];
      __builtin_prefetch(&number[v]);
      __builtin_prefetch(&vertices[3 * int64_t{v}]);
    }
    for (int corner = 0; corner < 3; ++corner) {
      const int32_t v = faces[mesh.face_of[k]][corner];
      if (number[v] < 0) {
        number[v] = static_cast<int32_t>(mesh.vertex_of.size());
        mesh.vertex_of.push_back(v);
        for (int axis = 0; axis < 3; ++axis) mesh.vertices.push_back(vertices[3 * int64_t{v} + axis]);
      }
      mesh.faces[k][corner] = number[v];
    }
  }
  return mesh;
}

}  // namespace pgccd
