#include "kernels/bounds/bounds_cuda.h"
#include "kernels/bounds/refit_item.h"
#include "kernels/device.cuh"

namespace pgccd {
namespace {

constexpr int kRefitThreads = 256;

// Scratch rows of a body start at its block_begin; a mesh never has more chunks of faces than blocks of nodes.
struct RefitScratch {
  Vec3<double>* chunk_sums[2];  // (blocks)
  NodeBounds* nodes;            // (blocks, 8)
  int32_t* parent;              // (blocks) block of the parent node
  int32_t* pending;             // (blocks) children's blocks not done yet
};

// One thread block a body.
__global__ void __launch_bounds__(kRefitThreads)
    refit_bodies(DeformingInput input, DeformingBounds bounds, RefitScratch scratch) {
  const int64_t body = blockIdx.x;
  const int32_t mesh = input.mesh_index[body];
  const MeshOffsets& offsets = input.meshes.offsets[mesh];
  const MeshOffsets& next = input.meshes.offsets[mesh + 1];
  const int64_t face_count = next.face - offsets.face, block_count = next.block - offsets.block;
  const int32_t* faces = input.meshes.faces + 3 * offsets.face;
  const int64_t first = input.block_begin[body];
  __shared__ BodyShape shape;
  __shared__ unsigned long long largest_squared;
  if (threadIdx.x == 0) {
    largest_squared = 0;
    shape.vertices[0] = input.vertices_t0 + 3 * input.vertex_begin[body];
    shape.vertices[1] = input.vertices_t1 + 3 * input.vertex_begin[body];
  }
  __syncthreads();

  const int64_t chunk_count = (face_count + kMeanChunk - 1) / kMeanChunk;
  for (int64_t task = threadIdx.x; task < 2 * chunk_count; task += blockDim.x) {
    const int end = task < chunk_count ? 0 : 1;
    const int64_t chunk = task - end * chunk_count;
    scratch.chunk_sums[end][first + chunk] = corner_sum(faces, face_count, chunk, shape.vertices[end]);
  }
  __syncthreads();
  if (threadIdx.x < 2) {
    const int end = threadIdx.x;
    Vec3<double> sum{0.0, 0.0, 0.0};
    for (int64_t chunk = 0; chunk < chunk_count; ++chunk) sum = sum + scratch.chunk_sums[end][first + chunk];
    shape.centre[end] = (1.0 / (3.0 * static_cast<double>(face_count))) * sum;
    store_vec3((end == 0 ? bounds.position_t0 : bounds.position_t1) + 3 * body, shape.centre[end]);
  }
  __syncthreads();

  double squared = 0.0;
  for (int64_t corner = threadIdx.x; corner < 3 * face_count; corner += blockDim.x) {
    for (int end = 0; end < 2; ++end) squared = larger(squared, norm_squared(shape.local(end, faces[corner])));
  }
  atomicMax(&largest_squared,
            static_cast<unsigned long long>(__double_as_longlong(squared)));  // >= 0: bits are in order
  __syncthreads();
  if (threadIdx.x == 0) {
    bounds.radius[body] = std::sqrt(__longlong_as_double(static_cast<long long>(largest_squared))) * (1.0 + 0x1p-40);
  }

  const Triangle* triangles = input.meshes.triangles + offsets.face;
  const NodeLink* links = input.meshes.node_links + offsets.block * kBlockWidth;
  for (int64_t block = threadIdx.x; block < block_count; block += blockDim.x) {
    int32_t inner = 0;
    for (int slot = 0; slot < used_slots(links, block); ++slot) {
      const NodeLink link = links[block * kBlockWidth + slot];
      if (link.triangle_count > 0) continue;
      ++inner;
      scratch.parent[first + link.first] = static_cast<int32_t>(block);
    }
    scratch.pending[first + block] = inner;
  }
  __syncthreads();
  // Bottom up: whoever finishes a block's last child goes on with that block (Karras 2012).
  for (int64_t start = threadIdx.x; start < block_count; start += blockDim.x) {
    bool has_children = false;
    for (int slot = 0; slot < used_slots(links, start); ++slot) {
      has_children = has_children || links[start * kBlockWidth + slot].triangle_count == 0;
    }
    if (has_children) continue;
    for (int64_t block = start;;) {
      refit_block(shape, triangles, links, block, scratch.nodes + first * kBlockWidth, bounds.blocks_t0 + first + block,
                  bounds.blocks_t1 + first + block);
      if (block == 0) break;
      __threadfence();
      const int64_t parent = scratch.parent[first + block];
      if (atomicSub(scratch.pending + first + parent, 1) != 1) break;
      __threadfence();
      block = parent;
    }
  }
}

}  // namespace

void rotations_between_cuda(const DeviceContext& context, const double* orientation_t0, const double* orientation_t1,
                            int64_t count, double* rotation) {
  for_each_item(context, count, [=] __device__(int64_t b) {
    store_vec3(rotation + 3 * b,
               rotation_between(load_quaternion(orientation_t0 + 4 * b), load_quaternion(orientation_t1 + 4 * b)));
  });
}

void refit_cuda(const DeviceContext& context, const DeformingInput& input, const DeformingBounds& bounds) {
  if (input.body_count == 0) return;
  RefitScratch scratch;
  for (auto& sums : scratch.chunk_sums) sums = context.allocate<Vec3<double>>(input.block_count);
  scratch.nodes = context.allocate<NodeBounds>(input.block_count * kBlockWidth);
  scratch.parent = context.allocate<int32_t>(input.block_count);
  scratch.pending = context.allocate<int32_t>(input.block_count);
  refit_bodies<<<static_cast<unsigned>(input.body_count), kRefitThreads, 0, context.stream>>>(input, bounds, scratch);
  check_cuda(cudaGetLastError(), "refit_bodies");
}

}  // namespace pgccd
