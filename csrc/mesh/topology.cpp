#include "mesh/topology.h"

#include <algorithm>

namespace pgccd {

Topology make_topology(const std::vector<Face>& faces) {
  struct HalfEdge {
    Edge edge;
    int64_t face;
    int corner;
  };
  std::vector<HalfEdge> halves;
  halves.reserve(3 * faces.size());
  for (size_t f = 0; f < faces.size(); ++f) {
    for (int corner = 0; corner < 3; ++corner) {
      const int32_t p = faces[f][corner], q = faces[f][(corner + 1) % 3];
      halves.push_back({{std::min(p, q), std::max(p, q)}, static_cast<int64_t>(f), corner});
    }
  }
  std::sort(halves.begin(), halves.end(), [](const HalfEdge& a, const HalfEdge& b) { return a.edge < b.edge; });
  Topology topology;
  topology.face_edges.resize(faces.size());
  for (const HalfEdge& half : halves) {
    if (topology.edges.empty() || topology.edges.back() != half.edge) topology.edges.push_back(half.edge);
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
