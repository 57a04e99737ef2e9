// Operators of the voxel-based baseline.
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def(
      "voxels_touched(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, float voxel_size, float min_separation, "
      "float tolerance) -> (Tensor voxels, Tensor counts)");
  library.def(
      "voxel_boxes(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, float voxel_size, float min_separation, "
      "float tolerance, Tensor voxels, Tensor counts) -> Tensor");
  library.def(
      "voxel_pairs(Tensor boxes, Tensor segments, Tensor voxels, Tensor first_segment, float voxel_size) -> Tensor");
}
