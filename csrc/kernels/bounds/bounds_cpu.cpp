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
  const int64_t face_count = next.face - offsets.face, block_count = next.block - offsets.block;
  const int32_t* faces = input.meshes.faces + 3 * offsets.face;
  BodyShape shape;
  shape.vertices[0] = input.vertices_t0 + 3 * input.vertex_begin[body];
  shape.vertices[1] = input.vertices_t1 + 3 * input.vertex_begin[body];
  for (int end = 0; end < 2; ++end) shape.centre[end] = mean_corner(faces, face_count, shape.vertices[end]);
  store(bounds.position_t0 + 3 * body, shape.centre[0]);
  store(bounds.position_t1 + 3 * body, shape.centre[1]);

  double squared = 0.0;
  for (int64_t corner = 0; corner < 3 * face_count; ++corner) {
    for (int end = 0; end < 2; ++end) squared = larger(squared, norm_squared(shape.local(end, faces[corner])));
  }
  bounds.radius[body] = std::sqrt(squared) * (1.0 + 0x1p-40);

  const Triangle* triangles = input.meshes.triangles + offsets.face;
  const NodeLink* links = input.meshes.node_links + offsets.block * kBlockWidth;
  std::vector<NodeBounds> nodes(block_count * kBlockWidth);
  const auto occupied = [&](int64_t block) {
    int count = 0;
    while (count < kBlockWidth && (links[block * kBlockWidth + count].first | links[block * kBlockWidth + count].triangle_count)) {
      ++count;
    }
    return count;
  };
  // Blocks of parents precede those of their children, so backwards is bottom-up.
  for (int64_t block = block_count - 1; block >= 0; --block) {
    NodeBlock* targets[2] = {bounds.blocks_t0 + input.block_begin[body] + block, bounds.blocks_t1 + input.block_begin[body] + block};
    const int count = occupied(block);
    for (int slot = 0; slot < kBlockWidth; ++slot) {
      const int64_t n = block * kBlockWidth + slot;
      if (slot < count) {
        nodes[n] = links[n].triangle_count > 0
                       ? leaf_bounds(shape, triangles, links[n])
                       : parent_bounds(shape, triangles, &nodes[int64_t(links[n].first) * kBlockWidth], occupied(links[n].first));
      }
      for (int end = 0; end < 2; ++end) {
        if (slot < count) store_node(nodes[n], end, slot, *targets[end]);
        if (slot >= count) store_empty(slot, *targets[end]);
      }
    }
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
