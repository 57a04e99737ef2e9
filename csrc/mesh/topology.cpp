#include "mesh/topology.h"

#include <algorithm>

namespace pgccd {

Topology make_topology(const std::vector<Face>& faces) {
  // Both ends of an edge in one number, which sorts faster.
  struct HalfEdge {
    uint64_t ends;
    int64_t face;
    int corner;
  };
  std::vector<HalfEdge> halves;
  halves.reserve(3 * faces.size());
  for (size_t f = 0; f < faces.size(); ++f) {
    for (int corner = 0; corner < 3; ++corner) {
      const auto [p, q] = std::minmax({faces[f][corner], faces[f][(corner + 1) % 3]});
      halves.push_back({uint64_t(p) << 32 | uint64_t(q), static_cast<int64_t>(f), corner});
    }
  }
  std::sort(halves.begin(), halves.end(), [](const HalfEdge& a, const HalfEdge& b) { return a.ends < b.ends; });
  Topology topology;
  topology.face_edges.resize(faces.size());
  for (const HalfEdge& half : halves) {
    const Edge edge{static_cast<int32_t>(half.ends >> 32), static_cast<int32_t>(half.ends)};
    if (topology.edges.empty() || topology.edges.back() != edge) topology.edges.push_back(edge);
    topology.face_edges[half.face][half.corner] = static_cast<int32_t>(topology.edges.size() - 1);
  }
  return topology;
}

std::vector<int32_t> representatives(const std::vector<Face>& faces, const Topology& topology,
                                     const std::vector<int32_t>& order, int64_t vertex_count) {
  std::vector<bool> vertex_taken(vertex_count, false), edge_taken(topology.edges.size(), false);
  std::vector<int32_t> represented;
  represented.reserve(order.size());
  for (const int32_t f : order) {
    int32_t bits = 0;
    for (int corner = 0; corner < 3; ++corner) {
      const int32_t vertex = faces[f][corner], edge = topology.face_edges[f][corner];
      if (!vertex_taken[vertex]) bits |= 1 << corner;
      if (!edge_taken[edge]) bits |= 8 << corner;
      vertex_taken[vertex] = true;
      edge_taken[edge] = true;
    }
    represented.push_back(bits);
  }
  return represented;
}

}  // namespace pgccd
