// pgccd._host: mesh preparation on NumPy arrays, without torch, and information about this build.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstring>
#include <utility>
#include <vector>

#include "mesh/hierarchy.h"
#include "mesh/topology.h"

namespace py = pybind11;

namespace {

using pgccd::Face;

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;

// Rows of `Row` as a NumPy matrix of their `Element`s.
template <class Element, class Row>
py::array_t<Element> to_matrix(std::vector<Row>&& rows) {
  static_assert(sizeof(Row) % sizeof(Element) == 0);
  const auto columns = static_cast<py::ssize_t>(sizeof(Row) / sizeof(Element));
  auto* const owned = new std::vector<Row>(std::move(rows));
  const py::capsule owner(owned, [](void* p) { delete static_cast<std::vector<Row>*>(p); });
  return py::array_t<Element>({static_cast<py::ssize_t>(owned->size()), columns},
                              reinterpret_cast<const Element*>(owned->data()), owner);
}

py::dict prepare_mesh(const Array<double>& vertices, const Array<int32_t>& faces, int leaf_size) {
  std::vector<Face> rows(faces.shape(0));
  if (!rows.empty()) std::memcpy(rows.data(), faces.data(), rows.size() * sizeof(Face));
  if (leaf_size < 1 || leaf_size > pgccd::kMaxLeafTriangles) throw py::value_error("leaf_size: expected 1 to 8");
  pgccd::Topology topology;
  pgccd::Hierarchy tree;
  std::vector<pgccd::Triangle> triangles;
  {
    py::gil_scoped_release unlocked;
    topology = pgccd::make_topology(rows);
    tree = pgccd::build_hierarchy(vertices.data(), vertices.shape(0), rows, leaf_size);
    const std::vector<int32_t> represented =
        pgccd::representatives(rows, topology, tree.triangle_order, vertices.shape(0));
    triangles.reserve(rows.size());
    for (size_t k = 0; k < rows.size(); ++k) {
      const int32_t f = tree.triangle_order[k];
      const Face &v = rows[f], &e = topology.face_edges[f];
      triangles.push_back({{v[0], v[1], v[2]}, {e[0], e[1], e[2]}, f, represented[k]});
    }
  }
  py::dict out;
  out["edges"] = to_matrix<int32_t>(std::move(topology.edges));
  out["triangles"] = to_matrix<int32_t>(std::move(triangles));
  out["node_blocks"] = to_matrix<float>(std::move(tree.blocks));
  out["node_links"] = to_matrix<int32_t>(std::move(tree.links));
  out["node_supports"] = to_matrix<int32_t>(std::move(tree.supports));
  out["leaf_points"] = to_matrix<int32_t>(std::move(tree.leaf_points));
  return out;
}

#ifndef PGCCD_BUILD_COMMIT
#define PGCCD_BUILD_COMMIT ""
#endif
#ifndef PGCCD_BUILD_CUDA
#define PGCCD_BUILD_CUDA ""
#endif
#ifndef PGCCD_BUILD_CUDA_ARCHITECTURES
#define PGCCD_BUILD_CUDA_ARCHITECTURES ""
#endif

py::dict build_information() {
  py::dict out;
  out["version"] = PGCCD_VERSION;
  out["commit"] = PGCCD_BUILD_COMMIT;
  out["sources"] = PGCCD_BUILD_SOURCES;
  out["compiler"] = __VERSION__;
  out["cuda"] = PGCCD_BUILD_CUDA;
  out["cuda_architectures"] = PGCCD_BUILD_CUDA_ARCHITECTURES;
  return out;
}

}  // namespace

PYBIND11_MODULE(_host, module) {
  module.def("prepare_mesh", &prepare_mesh, py::arg("vertices"), py::arg("faces"), py::arg("leaf_size"),
             "Edges, triangles in leaf order with their represented features, and the hierarchy of a mesh. "
             "vertices (V, 3) float64, faces (F, 3) int32, valid and not empty.");
  module.def("build_information", &build_information,
             "Version, commit, digest of the C++ sources, compiler and CUDA of this build.");
}
