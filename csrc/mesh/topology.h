// What a face list implies: its edges, and which triangle stands for each vertex and edge.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace pgccd {

using Face = std::array<int32_t, 3>;
using Edge = std::array<int32_t, 2>;

struct Topology {
  std::vector<Edge> edges;       // each once, (smaller, larger) vertex, in lexicographic order
  std::vector<Face> face_edges;  // edge k joins vertex k and (k + 1) % 3 of the face
};

Topology make_topology(const std::vector<Face>& faces);

// For faces taken in `order`, six bits each: which of its vertices (bits 0-2) and edges (bits 3-5) it is the first to
// have.
std::vector<int32_t> representatives(const std::vector<Face>& faces, const Topology& topology,
                                     const std::vector<int32_t>& order, int64_t vertex_count);

}  // namespace pgccd
