// The operator that prepares a mesh, once: its topology and its hierarchy. On CPUs only.
#pragma once

#include <cstring>
#include <tuple>
#include <vector>

#include "bind/outputs.h"
#include "mesh/hierarchy.h"
#include "mesh/topology.h"

namespace pgccd::bind {

// Rows of `Row` as a tensor of this shape with their `Element`s.
template <class Element, class Row>
Tensor tensor_of_rows(const Tensor& like, const std::vector<Row>& rows, std::initializer_list<int64_t> shape) {
  static_assert(sizeof(Row) % sizeof(Element) == 0);
  Tensor tensor = new_tensor<Element>(like, shape);
  if (!rows.empty()) std::memcpy(data<Element>(tensor), rows.data(), rows.size() * sizeof(Row));
  return tensor;
}

// vertices (V, 3), faces (F, 3) i32, valid and not empty.
inline std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> prepare_mesh(const Tensor& vertices,
                                                                               const Tensor& faces, int64_t leaf_size) {
  const double* const x = rows<double>(vertices, "vertices", {kAnySize, 3});
  const Face* const given = rows<int32_t, Face>(faces, "faces", {kAnySize, 3});
  const int64_t vertex_count = vertices.size(0), count = faces.size(0);
  STD_TORCH_CHECK(count > 0, "faces: expected one at least");
  STD_TORCH_CHECK(leaf_size >= 1 && leaf_size <= kMaxLeafTriangles, "leaf_size: expected 1 to ", kMaxLeafTriangles,
                  ", got ", leaf_size);
  const std::vector<Face> table(given, given + count);
  for (const Face& face : table) {
    for (const int32_t vertex : face) {
      STD_TORCH_CHECK(vertex >= 0 && vertex < vertex_count, "faces: expected rows of ", vertex_count, " vertices, got ",
                      vertex);
    }
  }
  const Topology topology = make_topology(table);
  const Hierarchy tree = build_hierarchy(x, vertex_count, table, static_cast<int>(leaf_size));
  const std::vector<int32_t> represented = representatives(table, topology, tree.triangle_order, vertex_count);
  std::vector<Triangle> triangles;
  triangles.reserve(table.size());
  for (int64_t k = 0; k < count; ++k) {
    const int32_t f = tree.triangle_order[k];
    const Face &v = table[f], &e = topology.face_edges[f];
    triangles.push_back({{v[0], v[1], v[2]}, {e[0], e[1], e[2]}, f, represented[k]});
  }
  const auto blocks = static_cast<int64_t>(tree.blocks.size());
  return {
      tensor_of_rows<int32_t>(faces, topology.edges, {static_cast<int64_t>(topology.edges.size()), 2}),
      tensor_of_rows<int32_t>(faces, triangles, {count, 8}),
      tensor_of_rows<float>(faces, tree.blocks, {blocks, kBlockColumns, kBlockWidth}),
      tensor_of_rows<int32_t>(faces, tree.links, {blocks, kBlockWidth, 4}),
      tensor_of_rows<int32_t>(faces, tree.leaf_points, {static_cast<int64_t>(tree.leaf_points.size()), 4, kBlockWidth}),
      tensor_of_rows<int32_t>(faces, tree.supports, {blocks, kBlockWidth, 24})};
}

inline void register_mesh_ops(Library& library) { library.impl("prepare_mesh", PGCCD_BOX(prepare_mesh)); }

}  // namespace pgccd::bind
