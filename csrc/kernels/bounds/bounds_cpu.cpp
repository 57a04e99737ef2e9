#include <vector>

#include "kernels/bounds/bounds.h"
#include "kernels/bounds/moving_box_item.h"
#include "kernels/bounds/moving_sphere_item.h"
#include "kernels/bounds/refit_item.h"

namespace pgccd {
namespace {

Vec3<double> mean_corner(const int32_t* faces, int64_t face_count, const double* vertices) {
  Vec3<double> sum{0.0, 0.0, 0.0};
  for (int64_t chunk = 0; chunk * kMeanChunk < face_count; ++chunk) {
    sum = sum + corner_sum(faces, face_count, chunk, vertices);
  }
  return (1.0 / (3.0 * static_cast<double>(face_count))) * sum;
}

void refit_body(const DeformingInput& input, const DeformingBounds& bounds, int64_t body) {
  const int32_t mesh = input.mesh_index[body];
  const MeshOffsets& offsets = input.meshes.offsets[mesh];
  const MeshOffsets& next = input.meshes.offsets[mesh + 1];
  const int64_t face_count = next.face - offsets.face, block_count = next.block - offsets.block;
  const int32_t* faces = input.meshes.faces + 3 * offsets.face;
  BodyShape shape;
  shape.vertices[0] = input.vertices_t0 + 3 * input.vertex_begin[body];
  shape.vertices[1] = input.vertices_t1 + 3 * input.vertex_begin[body];
  for (int end = 0; end < 2; ++end) shape.centre[end] = mean_corner(faces, face_count, shape.vertices[end]);
  store_vec3(bounds.position_t0 + 3 * body, shape.centre[0]);
  store_vec3(bounds.position_t1 + 3 * body, shape.centre[1]);

  double squared = 0.0;
  for (int64_t corner = 0; corner < 3 * face_count; ++corner) {
    for (int end = 0; end < 2; ++end) squared = larger(squared, norm_squared(shape.local(end, faces[corner])));
  }
  bounds.radius[body] = std::sqrt(squared) * (1.0 + 0x1p-40);

  LocalVertex* vertices = bounds.local_vertices + input.vertex_begin[body];
  for (int32_t vertex = 0; vertex < next.vertex - offsets.vertex; ++vertex) {
    vertices[vertex] = local_vertex(shape, vertex);
  }

  const Triangle* triangles = input.meshes.triangles + offsets.face;
  const NodeLink* links = input.meshes.node_links + offsets.block * kBlockWidth;
  std::vector<NodeBounds> nodes(block_count * kBlockWidth);
  const int64_t first = input.block_begin[body];
  // Blocks of parents precede those of their children, so reverse order is bottom-up.
  for (int64_t block = block_count - 1; block >= 0; --block) {
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      refit_node(SingleThread{}, shape, triangles, links, block, slot, nodes.data(), bounds.blocks_t0 + first + block,
                 bounds.blocks_t1 + first + block);
    }
  }
}

}  // namespace

void rotations_between(const Executor& executor, const double* orientation_t0, const double* orientation_t1,
                       int64_t count, double* rotation) {
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      store_vec3(rotation + 3 * b, rotation_between(orientation_t0, orientation_t1, b));
    }
  });
}

void poses_at(const Executor& executor, const RigidPoses& poses, int64_t count, double* position, double* orientation) {
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) pose_at(poses, row, position, orientation);
  });
}

void shorten_arcs(const Executor& executor, const ShortenedArcs& arcs, int64_t count) {
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) arcs.shorten(body);
  });
}

void moving_spheres(const Executor& executor, const RigidBodies& bodies, int64_t count, const MovingSpheres& out) {
  require_rows(executor, count, "bodies.mesh_index", "name meshes",
               [&](int64_t body) { return names_mesh(bodies, body); });
  parallel_chunks(executor, count, 1024, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      const MovingSphere sphere = moving_sphere(bodies, b);
      store_vec3(out.centre_t0 + 3 * b, sphere.centre_t0);
      store_vec3(out.centre_t1 + 3 * b, sphere.centre_t1);
      out.reach[b] = sphere.reach;
    }
  });
}

template <class Bodies>
void moving_boxes(const Executor& executor, const Bodies& bodies, MovingBox* boxes) {
  const int64_t count = bodies.centres.count;
  require_rows(executor, count, "bodies", "name meshes, and vertices and node blocks that are there",
               [&](int64_t body) { return is_sound(bodies, body); });
  parallel_chunks(executor, count, 64, [&](int, int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) boxes[b] = moving_box(SingleThread{}, bodies, b);
  });
}
template void moving_boxes(const Executor&, const RigidBodies&, MovingBox*);
template void moving_boxes(const Executor&, const DeformingBodies&, MovingBox*);

void refit(const Executor& executor, const DeformingInput& input, const DeformingBounds& bounds) {
  require_rows(executor, input.body_count, "mesh_index, vertex_begin, block_begin",
               "name a mesh, and where all its vertices and node blocks are",
               [&](int64_t body) { return is_sound(input, body); });
  parallel_chunks(executor, input.body_count, 1, [&](int, int64_t begin, int64_t end) {
    for (int64_t body = begin; body < end; ++body) refit_body(input, bounds, body);
  });
}

}  // namespace pgccd
