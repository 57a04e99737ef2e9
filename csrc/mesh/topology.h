// Topology of a face list: its edges, and the element that represents each vertex and edge.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/mesh_set.h"

namespace pgccd {

using Face = std::array<int32_t, 3>;
using Edge = std::array<int32_t, 2>;

inline ElementKind kind_of(const Face& face) {
  if (face[1] != face[2]) return ElementKind::kTriangle;
  return face[0] == face[1] ? ElementKind::kPoint : ElementKind::kSegment;
}

struct Topology {
  std::vector<Edge> edges;       // each once, (smaller, larger) vertex, in lexicographic order
  std::vector<Face> face_edges;  // edge k joins vertex k and (k + 1) % 3 of the face; -1 if they are the same
};

Topology make_topology(const std::vector<Face>& faces);

// For faces in `order`: the vertices (bits 0-2) and edges (bits 3-5) for which it is the first face, and its kind.
std::vector<int32_t> representatives(const std::vector<Face>& faces, const Topology& topology,
                                     const std::vector<int32_t>& order, int64_t vertex_count);

}  // namespace pgccd
