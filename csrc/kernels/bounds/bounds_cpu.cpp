#include <vector>

#include "kernels/bounds/bounds.h"
#include "kernels/bounds/refit_item.h"

namespace pgccd {
namespace {

void store(double* row, Vec3<double> v) {
  row[0] = v.x;
  row[1] = v.y;
  row[2] = v.z;
}

void refit_body(const DeformingInput& input, const DeformingBounds& bounds, int64_t body) {
  const int32_t mesh = input.mesh_index[body];
  const MeshOffsets& offsets = input.meshes.offsets[mesh];
  const MeshOffsets& next = input.meshes.offsets[mesh + 1];
  const int64_t face_count = next.face - offsets.face, node_count = next.node - offsets.node;
  const int32_t* faces = input.meshes.faces + 3 * offsets.face;
  BodyShape shape;
  shape.vertices[0] = input.vertices_t0 + 3 * input.vertex_begin[body];
  shape.vertices[1] = input.vertices_t1 + 3 * input.vertex_begin[body];
  for (int end = 0; end < 2; ++end) shape.centre[end] = mean_corner(faces, face_count, shape.vertices[end]);
  store(bounds.position_t0 + 3 * body, shape.centre[0]);
  store(bounds.position_t1 + 3 * body, shape.centre[1]);

  double squared = 0.0;
  for (int64_t corner = 0; corner < 3 * face_count; ++corner) {
    for (int end = 0; end < 2; ++end) squared = std::fmax(squared, norm_squared(shape.local(end, faces[corner])));
  }
  bounds.radius[body] = std::sqrt(squared) * (1.0 + 0x1p-40);

  const Triangle* triangles = input.meshes.triangles + offsets.face;
  const NodeLink* links = input.meshes.node_links + offsets.node;
  std::vector<NodeBounds> nodes(node_count);
  // Parents precede their children, so backwards is bottom-up.
  for (int64_t n = node_count - 1; n >= 0; --n) {
    const NodeLink link = links[n];
    nodes[n] = link.triangle_count > 0 ? leaf_bounds(shape, triangles, link)
                                       : parent_bounds(shape, triangles, nodes[link.first], nodes[link.first + 1]);
    bounds.spheres_t0[input.node_begin[body] + n] = node_sphere(nodes[n], 0);
    bounds.spheres_t1[input.node_begin[body] + n] = node_sphere(nodes[n], 1);
  }
}

}  // namespace

void rotations_between_cpu(const Executor& executor, const double* orientation_t0, const double* orientation_t1,
                           int64_t count, double* rotation) {
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      store(rotation + 3 * b,
            rotation_between(load_quaternion(orientation_t0 + 4 * b), load_quaternion(orientation_t1 + 4 * b)));
    }
  });
}

void refit_cpu(const Executor& executor, const DeformingInput& input, const DeformingBounds& bounds) {
  parallel_chunks(executor, input.body_count, 1, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) refit_body(input, bounds, body);
  });
}

}  // namespace pgccd
