#include "kernels/bounds/bounds.h"
#include "kernels/bounds/moving_box_item.h"
#include "kernels/bounds/moving_sphere_item.h"
#include "kernels/bounds/refit_item.h"
#include "kernels/launch.cuh"

namespace pgccd {
namespace {

// Work is distributed by node blocks of all bodies, whose number is proportional to a body's size.
struct Refit {
  DeformingInput input;
  DeformingBounds bounds;
  Vec3<double>* chunk_sums[2];          // (blocks); a mesh has no more chunks of faces than node blocks
  unsigned long long* largest_squared;  // (bodies) bits of the largest squared radius so far, which have the same order
  NodeBounds* nodes;                    // (blocks, 8)
  int32_t* body_of_block;               // (blocks)
  int32_t* parent;                      // (blocks) block of the parent node, local to its body
  int32_t* pending;                     // (blocks) number of children's blocks not finished yet
};

constexpr int32_t kNoBody = -1;

// A body's mesh and rows.
struct RefitBody {
  int64_t index;
  int64_t first_block, block_count, face_count, vertex_count;
  const int32_t* faces;
  const Triangle* triangles;
  const NodeLink* links;
};

__device__ RefitBody refit_body(const DeformingInput& input, int64_t body) {
  const MeshOffsets& offsets = input.meshes.offsets[input.mesh_index[body]];
  const MeshOffsets& next = input.meshes.offsets[input.mesh_index[body] + 1];
  return {body,
          input.block_begin[body],
          next.block - offsets.block,
          next.face - offsets.face,
          next.vertex - offsets.vertex,
          input.meshes.faces + 3 * offsets.face,
          input.meshes.triangles + offsets.face,
          input.meshes.node_links + offsets.block * kBlockWidth};
}

__device__ RefitBody body_of_block(const Refit& refit, int64_t row) {
  return refit_body(refit.input, refit.body_of_block[row]);
}

__device__ const double* body_vertices(const DeformingInput& input, int64_t body, int end) {
  return (end == 0 ? input.vertices_t0 : input.vertices_t1) + 3 * input.vertex_begin[body];
}

__device__ BodyShape body_shape(const Refit& refit, int64_t body) {
  BodyShape shape;
  for (int end = 0; end < 2; ++end) {
    shape.vertices[end] = body_vertices(refit.input, body, end);
    shape.centre[end] = load_vec3((end == 0 ? refit.bounds.position_t0 : refit.bounds.position_t1) + 3 * body);
  }
  return shape;
}

// Sums of `value(k)` for k < count, in order: a warp fetches kStaged values at a time, and three of its lanes sum one
// coordinate each. The result is in lane 0.
constexpr int kStaged = 96;
template <class Value>
__device__ Vec3<double> sum_in_order(int64_t count, double (&staged)[kStaged][3], Value&& value) {
  const int lane = threadIdx.x % kWarp;
  double sum = 0.0;
  for (int64_t begin = 0; begin < count; begin += kStaged) {
    const int taken = static_cast<int>(smaller<int64_t>(kStaged, count - begin));
    for (int k = lane; k < taken; k += kWarp) {
      const Vec3<double> x = value(begin + k);
      staged[k][0] = x.x;
      staged[k][1] = x.y;
      staged[k][2] = x.z;
    }
    __syncwarp();
    for (int k = 0; lane < 3 && k < taken; ++k) sum = sum + staged[k][lane];
    __syncwarp();  // before the buffer is overwritten
  }
  return {__shfl_sync(kAllLanes, sum, 0), __shfl_sync(kAllLanes, sum, 1), __shfl_sync(kAllLanes, sum, 2)};
}

// The same number of warps per body: several if there are few bodies, which may be large.
__global__ void __launch_bounds__(kBlockThreads) name_bodies(Refit refit, int warps_a_body) {
  wait_for_previous_kernels();
  const int64_t warp = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  const int64_t index = warp / warps_a_body, first = kWarp * (warp % warps_a_body);
  if (index >= refit.input.body_count) return;
  require_on_device(is_sound(refit.input, index),
                    "mesh_index, vertex_begin, block_begin: expected rows that are there");
  const RefitBody body = refit_body(refit.input, index);
  for (int64_t block = first + threadIdx.x % kWarp; block < body.block_count; block += kWarp * warps_a_body) {
    const int32_t other = atomicExch(refit.body_of_block + body.first_block + block, static_cast<int32_t>(index));
    require_on_device(other == kNoBody, "block_begin: expected blocks of one body each");
  }
}

// One warp per node block and end of the step: sums the chunk with the block's number, if the mesh has one.
__global__ void __launch_bounds__(kBlockThreads) sum_chunks(Refit refit) {
  wait_for_previous_kernels();
  __shared__ double staged[kWarpsPerBlock][kStaged][3];
  const int64_t task = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (task >= 2 * refit.input.block_count) return;
  const int end = static_cast<int>(task % 2);
  const int64_t row = task / 2;
  if (refit.body_of_block[row] == kNoBody) return;
  const RefitBody body = body_of_block(refit, row);
  const int64_t first = (row - body.first_block) * kMeanChunk;
  if (first >= body.face_count) return;
  const int32_t* corners = body.faces + 3 * first;
  const double* vertices = body_vertices(refit.input, body.index, end);
  const Vec3<double> sum = sum_in_order(3 * smaller(kMeanChunk, body.face_count - first), staged[threadIdx.x / kWarp],
                                        [&](int64_t k) { return load_vec3(vertices + 3 * int64_t(corners[k])); });
  if (threadIdx.x % kWarp == 0) refit.chunk_sums[end][row] = sum;
}

// One warp per body and end of the step.
__global__ void __launch_bounds__(kBlockThreads) place_centres(Refit refit) {
  wait_for_previous_kernels();
  __shared__ double staged[kWarpsPerBlock][kStaged][3];
  const int64_t task = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (task >= 2 * refit.input.body_count) return;
  const int end = static_cast<int>(task % 2);
  const RefitBody body = refit_body(refit.input, task / 2);
  const Vec3<double>* sums = refit.chunk_sums[end] + body.first_block;
  const Vec3<double> sum = sum_in_order((body.face_count + kMeanChunk - 1) / kMeanChunk, staged[threadIdx.x / kWarp],
                                        [&](int64_t k) { return sums[k]; });
  if (threadIdx.x % kWarp == 0) {
    store_vec3((end == 0 ? refit.bounds.position_t0 : refit.bounds.position_t1) + 3 * body.index,
               (1.0 / (3.0 * static_cast<double>(body.face_count))) * sum);
  }
}

// One warp per node block: measures an equal share of its body's corners, places an equal share of its vertices, and
// records the blocks below this one.
__global__ void __launch_bounds__(kBlockThreads) measure_bodies(Refit refit) {
  wait_for_previous_kernels();
  const int lane = threadIdx.x % kWarp;
  const int64_t row = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (row >= refit.input.block_count || refit.body_of_block[row] == kNoBody) return;
  const RefitBody body = body_of_block(refit, row);
  const int64_t block = row - body.first_block;
  const BodyShape shape = body_shape(refit, body.index);
  const int64_t corner_count = 3 * body.face_count;
  const int64_t corners_end = (block + 1) * corner_count / body.block_count;
  double squared = 0.0;
  for (int64_t corner = block * corner_count / body.block_count + lane; corner < corners_end; corner += kWarp) {
    for (int end = 0; end < 2; ++end) squared = larger(squared, norm_squared(shape.local(end, body.faces[corner])));
  }
  LocalVertex* vertices = refit.bounds.local_vertices + refit.input.vertex_begin[body.index];
  const int64_t vertices_end = (block + 1) * body.vertex_count / body.block_count;
  for (int64_t vertex = block * body.vertex_count / body.block_count + lane; vertex < vertices_end; vertex += kWarp) {
    vertices[vertex] = local_vertex(shape, static_cast<int32_t>(vertex));
  }
  for (int step = kWarp / 2; step > 0; step /= 2) {
    squared = larger(squared, __shfl_xor_sync(kAllLanes, squared, step));
  }
  const bool has_child = lane < kBlockWidth && body.links[block * kBlockWidth + lane].triangle_count == 0;
  if (has_child) {
    refit.parent[body.first_block + body.links[block * kBlockWidth + lane].first] = static_cast<int32_t>(block);
  }
  const uint32_t children = __ballot_sync(kAllLanes, has_child);
  if (lane == 0) {
    refit.pending[row] = __popc(children);
    atomicMax(refit.largest_squared + body.index, static_cast<unsigned long long>(__double_as_longlong(squared)));
  }
}

// The lanes of a warp that measure a node: those of a slot.
class SlotLanes {
 public:
  static constexpr int kCount = kWarp / kBlockWidth;
  __device__ explicit SlotLanes(int lane) : first_(lane - lane % kCount), index_(lane % kCount) {}
  __device__ int index() const { return index_; }
  __device__ double from(double x, int index) const {
    constexpr unsigned kLanes = (1u << kCount) - 1u;
    return __shfl_sync(kLanes << first_, x, first_ + index);
  }

 private:
  int first_, index_;
};

// One warp per block. Bottom-up from the blocks without children: the warp that finishes a block's last child continues
// with that block (Karras 2012).
__global__ void __launch_bounds__(kBlockThreads) refit_nodes(Refit refit) {
  wait_for_previous_kernels();
  const int lane = threadIdx.x % kWarp, slot = lane / SlotLanes::kCount;
  const SlotLanes team(lane);
  const int64_t row = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarp;
  if (row >= refit.input.block_count || refit.body_of_block[row] == kNoBody) return;
  const RefitBody body = body_of_block(refit, row);
  const BodyShape shape = body_shape(refit, body.index);
  const int64_t first = body.first_block;
  int64_t block = row - first;
  if (block == 0 && lane == 0) {
    const auto squared = static_cast<long long>(refit.largest_squared[body.index]);
    refit.bounds.radius[body.index] = std::sqrt(__longlong_as_double(squared)) * (1.0 + 0x1p-40);
  }
  const bool has_child = body.links[block * kBlockWidth + slot].triangle_count == 0;
  if (__ballot_sync(kAllLanes, has_child) != 0) return;
  for (;;) {
    refit_node(team, shape, body.triangles, body.links, block, slot, refit.nodes + first * kBlockWidth,
               refit.bounds.blocks_t0 + first + block, refit.bounds.blocks_t1 + first + block);
    if (block == 0) return;
    __threadfence();
    __syncwarp();  // all slots are written before the parent is signalled
    const int64_t parent = refit.parent[first + block];
    int32_t pending = 0;
    if (lane == 0) pending = atomicSub(refit.pending + first + parent, 1);
    if (__shfl_sync(kAllLanes, pending, 0) != 1) return;
    __threadfence();
    block = parent;
  }
}

// The lanes of a warp that measure a body.
struct WarpLanes {
  static constexpr int kCount = kWarp;
  __device__ int index() const { return static_cast<int>(threadIdx.x % kWarp); }
  __device__ double from(double x, int index) const { return __shfl_sync(kAllLanes, x, index); }
};

// One thread per rigid body, one warp per deforming one.
template <class Team, class Bodies>
__global__ void __launch_bounds__(kBlockThreads) make_boxes(Bodies bodies, MovingBox* boxes) {
  wait_for_previous_kernels();
  const Team team;
  const int64_t body = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / Team::kCount;
  if (body >= bodies.centres.count) return;
  require_on_device(is_sound(bodies, body), "bodies: expected rows of meshes, and vertices and node blocks");
  const MovingBox box = moving_box(team, bodies, body);
  if (team.index() == 0) boxes[body] = box;
}

}  // namespace

void rotations_between(const DeviceContext& context, const double* orientation_t0, const double* orientation_t1,
                       int64_t count, double* rotation) {
  for_each_item(context, count, [=] __device__(int64_t b) {
    store_vec3(rotation + 3 * b, rotation_between(orientation_t0, orientation_t1, b));
  });
}

void poses_at(const DeviceContext& context, const RigidPoses& poses, int64_t count, double* position,
              double* orientation) {
  for_each_item(context, count, [=] __device__(int64_t row) { pose_at(poses, row, position, orientation); });
}

void shorten_arcs(const DeviceContext& context, const ShortenedArcs& arcs, int64_t count) {
  for_each_item(context, count, [=] __device__(int64_t body) { arcs.shorten(body); });
}

void moving_spheres(const DeviceContext& context, const RigidBodies& bodies, int64_t count, const MovingSpheres& out) {
  for_each_item(context, count, [=] __device__(int64_t b) {
    require_on_device(names_mesh(bodies, b), "bodies.mesh_index: expected rows of meshes");
    const MovingSphere sphere = moving_sphere(bodies, b);
    store_vec3(out.centre_t0 + 3 * b, sphere.centre_t0);
    store_vec3(out.centre_t1 + 3 * b, sphere.centre_t1);
    out.reach[b] = sphere.reach;
  });
}

template <class Bodies>
void moving_boxes(const DeviceContext& context, const Bodies& bodies, MovingBox* boxes) {
  using Team = std::conditional_t<std::is_same_v<Bodies, RigidBodies>, SingleThread, WarpLanes>;
  if (bodies.centres.count == 0) return;
  launch_kernel(context, make_boxes<Team, Bodies>, blocks_for(Team::kCount * bodies.centres.count), kBlockThreads,
                bodies, boxes);
}
template void moving_boxes(const DeviceContext&, const RigidBodies&, MovingBox*);
template void moving_boxes(const DeviceContext&, const DeformingBodies&, MovingBox*);

void refit(const DeviceContext& context, const DeformingInput& input, const DeformingBounds& bounds) {
  if (input.body_count == 0) return;
  Refit refit;
  refit.input = input;
  refit.bounds = bounds;
  for (auto& sums : refit.chunk_sums) sums = context.allocate<Vec3<double>>(input.block_count);
  refit.largest_squared = context.allocate<unsigned long long>(input.body_count);
  refit.nodes = context.allocate<NodeBounds>(input.block_count * kBlockWidth);
  refit.body_of_block = context.allocate<int32_t>(input.block_count);
  refit.parent = context.allocate<int32_t>(input.block_count);
  refit.pending = context.allocate<int32_t>(input.block_count);
  fill_bytes(context, refit.largest_squared, 0, input.body_count);
  fill_bytes(context, refit.body_of_block, 0xff, input.block_count);
  const int64_t most_warps = (input.block_count + kWarp - 1) / kWarp;  // that have a block each
  const int warps_a_body = static_cast<int>(larger<int64_t>(1, most_warps / input.body_count));
  const auto run = [&](auto kernel, int64_t warps, const auto&... arguments) {
    launch_kernel(context, kernel, blocks_for(kWarp * warps), kBlockThreads, refit, arguments...);
  };
  run(name_bodies, warps_a_body * input.body_count, warps_a_body);
  run(sum_chunks, 2 * input.block_count);
  run(place_centres, 2 * input.body_count);
  run(measure_bodies, input.block_count);
  run(refit_nodes, input.block_count);
}

}  // namespace pgccd
