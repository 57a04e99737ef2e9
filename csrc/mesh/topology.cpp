#include "mesh/topology.h"

#include <algorithm>
#include <numeric>

namespace pgccd {

Topology make_topology(const std::vector<Face>& faces) {
  int32_t last_vertex = -1;
  for (const Face& face : faces) last_vertex = std::max({last_vertex, face[0], face[1], face[2]});
  // Edges by their first vertex, counted, then few at a time by their second.
  struct HalfEdge {
    int32_t second;
    int8_t corner;
    int64_t face;
  };
  std::vector<int64_t> begin(static_cast<size_t>(last_vertex) + 2);
  const auto for_each_half = [&](auto&& use) {
    for (size_t f = 0; f < faces.size(); ++f) {
      for (int8_t corner = 0; corner < 3; ++corner) {
        const auto [first, second] = std::minmax(faces[f][corner], faces[f][(corner + 1) % 3]);
        if (first != second) use(first, HalfEdge{second, corner, static_cast<int64_t>(f)});
      }
    }
  };
  for_each_half([&](int32_t first, const HalfEdge&) { ++begin[first + 1]; });
  std::partial_sum(begin.begin(), begin.end(), begin.begin());
  std::vector<HalfEdge> halves(static_cast<size_t>(begin.back()));
  std::vector<int64_t> next(begin.begin(), begin.end() - 1);
  for_each_half([&](int32_t first, const HalfEdge& half) { halves[next[first]++] = half; });
  Topology topology;
  topology.face_edges.resize(faces.size(), {-1, -1, -1});
  topology.edges.reserve(2 * faces.size());
  for (int32_t first = 0; first <= last_vertex; ++first) {
    const auto from = halves.begin() + begin[first], to = halves.begin() + begin[first + 1];
    std::sort(from, to, [](const HalfEdge& a, const HalfEdge& b) { return a.second < b.second; });
    for (auto half = from; half != to; ++half) {
      if (half == from || (half - 1)->second != half->second) topology.edges.push_back({first, half->second});
      topology.face_edges[half->face][half->corner] = static_cast<int32_t>(topology.edges.size() - 1);
    }
  }
  return topology;
}

std::vector<int32_t> representatives(const std::vector<Face>& faces, const Topology& topology,
                                     const std::vector<int32_t>& order, int64_t vertex_count) {
  std::vector<bool> vertex_taken(vertex_count, false), edge_taken(topology.edges.size(), false);
  std::vector<int32_t> represented;
  represented.reserve(order.size());
  for (size_t k = 0; k < order.size(); ++k) {
    const int32_t f = order[k];
    constexpr size_t kAhead = 24;  // faces of large meshes are read in no order
    if (k + kAhead < order.size()) {
      __builtin_prefetch(&faces[order[k + kAhead]]);
      __builtin_prefetch(&topology.face_edges[order[k + kAhead]]);
    }
    int32_t bits = static_cast<int32_t>(kind_of(faces[f])) << 6;
    for (int corner = 0; corner < 3; ++corner) {
      const int32_t vertex = faces[f][corner], edge = topology.face_edges[f][corner];
      if (!vertex_taken[vertex]) bits |= 1 << corner;
      vertex_taken[vertex] = true;
      if (edge < 0) continue;
      if (!edge_taken[edge]) bits |= 8 << corner;
      edge_taken[edge] = true;
    }
    represented.push_back(bits);
  }
  return represented;
}

}  // namespace pgccd
