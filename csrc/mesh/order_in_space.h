// A mesh with its faces and vertices in an order in which neighbours in space are neighbours in memory: a large one is
// built several times faster.
#pragma once

#include <cstdint>
#include <vector>

#include "mesh/topology.h"

namespace pgccd {

struct MeshInSpace {
  std::vector<double> vertices;    // x, y, z rows of the used ones
  std::vector<Face> faces;         // of these
  std::vector<int32_t> vertex_of;  // rows in the given mesh
  std::vector<int32_t> face_of;
};

// Kinds stay one after the other.
MeshInSpace order_in_space(const double* vertices, int64_t vertex_count, const std::vector<Face>& faces);

}  // namespace pgccd
