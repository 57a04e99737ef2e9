// Operators of the voxel-based baseline, on the CPU alone.
#pragma once

#include "bind/cpu_session.h"
#include "bind/outputs.h"
#include "kernels/voxel/voxel.h"

namespace pgccd::bind {

inline VoxelBodies voxel_bodies(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                double voxel_size, double min_separation, double tolerance) {
  const KeptDistance kept(min_separation, tolerance);
  STD_TORCH_CHECK(voxel_size > 0.0 && voxel_size <= kLargestLength, "voxel_size: expected a length in (0, 1e150], got ",
                  voxel_size);
  VoxelBodies input{rigid_view(mesh_set, bodies, linear_path), voxel_size, kept.separation, kept.tolerance};
  STD_TORCH_CHECK(input.bodies.centres.count < (int64_t{1} << 31), "bodies: more than 2^31 - 1 on one rank");
  require_rows(TorchExecutor(), input.bodies.centres.count, "bodies", "name a mesh of the set",
               [&](int64_t row) { return is_sound(input.bodies, row); });
  return input;
}

inline std::tuple<Tensor, Tensor> voxels_touched(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                                 double voxel_size, double min_separation, double tolerance) {
  const VoxelBodies input = voxel_bodies(mesh_set, bodies, linear_path, voxel_size, min_separation, tolerance);
  std::optional<std::tuple<Tensor, Tensor>> out;
  pgccd::voxels_touched(TorchExecutor(), input, [&](int64_t count) {
    out.emplace(new_tensor<int32_t>(bodies[0], {count, 3}), new_tensor<int64_t>(bodies[0], {count}));
    return TouchedVoxels{data<Voxel>(std::get<0>(*out)), data<int64_t>(std::get<1>(*out))};
  });
  return *out;
}

// Voxel coordinates are packed into a key.
inline const Voxel* voxel_rows(const Tensor& voxels, int64_t count) {
  const Voxel* view = rows<int32_t, Voxel>(voxels, "voxels", {count, 3});
  const auto is_sound = [](int32_t place) { return place > -kVoxelLimit && place < kVoxelLimit; };
  require_rows(TorchExecutor(), voxels.size(0), "voxels", "are below 2^20",
               [&](int64_t k) { return is_sound(view[k].x) && is_sound(view[k].y) && is_sound(view[k].z); });
  return view;
}

inline Tensor voxel_boxes(const TensorList& mesh_set, const TensorList& bodies, bool linear_path, double voxel_size,
                          double min_separation, double tolerance, const Tensor& voxels, const Tensor& counts) {
  const VoxelBodies input = voxel_bodies(mesh_set, bodies, linear_path, voxel_size, min_separation, tolerance);
  const int64_t voxel_count = counts.size(0);
  const int64_t* in_voxel = rows<int64_t>(counts, "counts", {kAnySize});
  const Voxel* places = voxel_rows(voxels, voxel_count);
  int64_t triangles = 0, total = 0;
  for (int64_t body = 0; body < input.bodies.centres.count; ++body) {
    const MeshOffsets* offsets = input.bodies.meshes.offsets + input.bodies.mesh_index[body];
    triangles += offsets[1].face - offsets[0].face;
  }
  for (int64_t k = 0; k < voxel_count; ++k) {
    STD_TORCH_CHECK(in_voxel[k] >= 0 && in_voxel[k] <= triangles, "counts: row ", k, ": expected at most ", triangles,
                    ", the number of triangles, got ", in_voxel[k]);
    total += in_voxel[k];
  }
  Tensor boxes = new_tensor<uint8_t>(counts, {total, sizeof(TriangleBox)});
  pgccd::voxel_boxes(TorchExecutor(), input, places, in_voxel, voxel_count, data<TriangleBox>(boxes));
  return boxes;
}

inline Tensor voxel_pairs(const Tensor& boxes, const Tensor& segments, const Tensor& voxels,
                          const Tensor& first_segment, double voxel_size) {
  STD_TORCH_CHECK(voxel_size > 0.0 && voxel_size <= kLargestLength, "voxel_size: expected a length in (0, 1e150], got ",
                  voxel_size);
  const int64_t box_count = boxes.size(0), segment_count = segments.size(0), voxel_count = voxels.size(0);
  VoxelContents contents;
  contents.boxes = rows<uint8_t, TriangleBox>(boxes, "boxes", {kAnySize, sizeof(TriangleBox)});
  contents.segments = rows<int64_t, BoxSegment>(segments, "segments", {kAnySize, 3});
  contents.voxels = voxel_rows(voxels, kAnySize);
  contents.first_segment = rows<int64_t>(first_segment, "first_segment", {voxel_count + 1});
  contents.voxel_count = voxel_count;
  contents.voxel_size = voxel_size;
  const TorchExecutor executor;
  require_rows(executor, segment_count, "segments", "are rows of the boxes", [&](int64_t k) {
    const BoxSegment& segment = contents.segments[k];
    return segment.count >= 0 && are_within(segment.begin, segment.count, box_count);
  });
  require_rows(executor, voxel_count + 1, "first_segment", "ascend from 0 to the number of segments", [&](int64_t k) {
    const int64_t least = k == 0 ? 0 : contents.first_segment[k - 1];
    const int64_t most = k == 0 ? 0 : segment_count;
    return contents.first_segment[k] >= least && contents.first_segment[k] <= most;
  });
  Tensor pairs;
  pgccd::voxel_pairs(executor, contents, [&](int64_t count) {
    pairs = new_tensor<int64_t>(segments, {count, 4});
    return data<TrianglePair>(pairs);
  });
  return pairs;
}

inline void register_voxel_ops(Library& library) {
  library.impl("voxels_touched", PGCCD_BOX(voxels_touched));
  library.impl("voxel_boxes", PGCCD_BOX(voxel_boxes));
  library.impl("voxel_pairs", PGCCD_BOX(voxel_pairs));
}

}  // namespace pgccd::bind
