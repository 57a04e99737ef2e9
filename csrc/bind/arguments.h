// From tensors to the views that the kernels read, with all checks. Tensor lists keep the schemas readable; their order
// is that of the fields in core/mesh_set.h and core/bodies.h.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <cstring>
#include <initializer_list>
#include <optional>
#include <type_traits>
#include <vector>

#include "bind/one_device.h"
#include "core/bodies.h"
#include "kernels/broad/broad.h"

namespace pgccd::bind {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using TensorList = std::vector<Tensor>;
using OptionalTensorList = std::vector<std::optional<Tensor>>;

constexpr int64_t kAnySize = -1;

template <class T>
constexpr ScalarType scalar_type_of() {
  if constexpr (std::is_same_v<T, double>) {
    return ScalarType::Double;
  } else if constexpr (std::is_same_v<T, float>) {
    return ScalarType::Float;
  } else if constexpr (std::is_same_v<T, int64_t>) {
    return ScalarType::Long;
  } else if constexpr (std::is_same_v<T, int32_t>) {
    return ScalarType::Int;
  } else if constexpr (std::is_same_v<T, int8_t>) {
    return ScalarType::Char;
  } else {
    static_assert(std::is_same_v<T, uint8_t>);
    return ScalarType::Byte;
  }
}

// Data of a contiguous tensor with this element type and shape, as rows of `Row`.
template <class Element, class Row = Element>
const Row* rows(const Tensor& tensor, const char* name, std::initializer_list<int64_t> shape) {
  check_device(tensor, name);
  STD_TORCH_CHECK(tensor.scalar_type() == scalar_type_of<Element>(), name, ": wrong dtype");
  STD_TORCH_CHECK(tensor.dim() == static_cast<int64_t>(shape.size()), name, ": expected ", shape.size(),
                  " dimensions, got ", tensor.dim());
  int64_t axis = 0;
  for (const int64_t size : shape) {
    STD_TORCH_CHECK(size == kAnySize || tensor.size(axis) == size, name, ": expected size ", size, " in dimension ",
                    axis, ", got ", tensor.size(axis));
    ++axis;
  }
  STD_TORCH_CHECK(tensor.is_contiguous(), name, ": expected a contiguous tensor");
  STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(tensor.data_ptr()) % alignof(Row) == 0, name,
                  ": expected memory aligned to ", alignof(Row), " bytes");
  return static_cast<const Row*>(tensor.data_ptr());
}

template <class Element>
const Element* optional_column(const std::optional<Tensor>& tensor, const char* name, int64_t count) {
  return tensor ? rows<Element>(*tensor, name, {count}) : nullptr;
}

// A list of numbers as a struct of such numbers.
template <class Fields, class Number>
Fields fields_of(const std::vector<Number>& numbers, const char* name) {
  constexpr size_t kCount = sizeof(Fields) / sizeof(Number);
  STD_TORCH_CHECK(numbers.size() == kCount, name, ": expected ", kCount, " values, got ", numbers.size());
  Fields fields;
  std::memcpy(&fields, numbers.data(), sizeof(Fields));
  return fields;
}

// Checks that rows of meshes are consecutive and within the columns. Other contents (corners of faces, children of
// nodes) are not checked: that would cost more than most operators.
inline void check_offsets(const MeshSetView& view, const MeshOffsets& sizes) {
  for (int64_t mesh = 0; mesh <= view.mesh_count; ++mesh) {
    const MeshOffsets from = mesh == 0 ? MeshOffsets{} : view.offsets[mesh - 1], at = view.offsets[mesh];
    const bool ascend = at.vertex >= from.vertex && at.face >= from.face && at.edge >= from.edge &&
                        at.block >= from.block && at.leaf_points >= from.leaf_points && at.corners >= from.corners;
    const bool end = at.vertex <= sizes.vertex && at.face <= sizes.face && at.edge <= sizes.edge &&
                     at.block <= sizes.block && at.leaf_points <= sizes.leaf_points && at.corners <= sizes.corners;
    STD_TORCH_CHECK(ascend && end, "mesh_set.offsets: row ", mesh, ": expected ascending rows of the other tensors");
  }
  const MeshOffsets first = view.offsets[0], last = view.offsets[view.mesh_count];
  const bool is_all = first.vertex == 0 && first.face == 0 && first.edge == 0 && first.block == 0 &&
                      first.leaf_points == 0 && first.corners == 0 && last.vertex == sizes.vertex &&
                      last.face == sizes.face && last.edge == sizes.edge && last.block == sizes.block &&
                      last.leaf_points == sizes.leaf_points && last.corners == sizes.corners;
  STD_TORCH_CHECK(is_all, "mesh_set.offsets: expected the first row to be 0, and the last one the sizes of the others");
}

inline MeshSetView mesh_set_view(const std::vector<Tensor>& t) {
  STD_TORCH_CHECK(t.size() == 16, "mesh_set: expected 16 tensors, got ", t.size());
  MeshSetView view;
  view.vertices = rows<double>(t[0], "mesh_set.vertices", {kAnySize, 3});
  view.faces = rows<int32_t>(t[1], "mesh_set.faces", {kAnySize, 3});
  view.edges = rows<int32_t>(t[2], "mesh_set.edges", {kAnySize, 2});
  view.triangles = rows<int32_t, Triangle>(t[3], "mesh_set.triangles", {t[1].size(0), 8});
  view.node_blocks = rows<float, NodeBlock>(t[4], "mesh_set.node_blocks", {kAnySize, kBlockColumns, kBlockWidth});
  view.node_links = rows<int32_t, NodeLink>(t[5], "mesh_set.node_links", {t[4].size(0), kBlockWidth, 4});
  view.leaf_points = rows<int32_t, LeafPoints>(t[6], "mesh_set.leaf_points", {kAnySize, 4, kBlockWidth});
  const int64_t corners = t[7].size(1) - kMaxLeafTriangles;
  view.corners = {rows<float>(t[7], "mesh_set.corners", {9, kAnySize}), t[7].size(1), corners != t[1].size(0)};
  STD_TORCH_CHECK(corners >= 0, "mesh_set.corners: columns are not padded");
  view.offsets = rows<int64_t, MeshOffsets>(t[8], "mesh_set.offsets", {kAnySize, 6});
  view.mesh_count = t[8].size(0) - 1;
  view.feature_count = std::max({t[0].size(0), t[1].size(0), t[2].size(0)});
  STD_TORCH_CHECK(view.mesh_count >= 0, "mesh_set.offsets: expected at least one row");
  if (!t[8].is_cuda()) {
    check_offsets(view, {t[0].size(0), t[1].size(0), t[2].size(0), t[4].size(0), t[6].size(0), corners});
  }
  // Empty if every mesh has its SBV centre at its origin.
  const int64_t centres = t[9].size(0) == 0 ? 0 : t[8].size(0) - 1;
  view.centres = rows<double>(t[9], "mesh_set.centres", {centres, 3});
  view.reaches = rows<double>(t[10], "mesh_set.reaches", {centres});
  if (centres == 0) view.centres = view.reaches = nullptr;
  // Empty if every mesh fills much of its SBV.
  const int64_t boxes = t[12].size(0) == 0 ? 0 : t[8].size(0) - 1;
  view.boxes = rows<double>(t[12], "mesh_set.boxes", {boxes, 4, 3});
  if (boxes == 0) view.boxes = nullptr;
  view.node_supports =
      rows<int32_t, NodeSupport>(t[11], "mesh_set.node_supports", {t[4].size(0), kBlockWidth, kSupportWords});
  // Empty if no mesh is a solid.
  const int64_t solids = t[13].size(0) == 0 ? 0 : t[8].size(0) - 1;
  view.solids = {rows<uint8_t>(t[13], "mesh_set.is_solid", {solids}),
                 rows<int64_t>(t[14], "mesh_set.piece_begin", {solids == 0 ? 0 : solids + 1}),
                 rows<int32_t>(t[15], "mesh_set.piece_vertex", {kAnySize})};
  if (solids == 0) view.solids = {};
  return view;
}

// Meshes and swept spheres of bodies, from `size` tensors, followed by margins if there are any.
template <class Bodies>
Bodies bodies_view(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& t, size_t size) {
  STD_TORCH_CHECK(t.size() == size || t.size() == size + 1, "bodies: expected ", size, " tensors, or ", size + 1,
                  " with margins, got ", t.size());
  Bodies view;
  view.meshes = mesh_set_view(mesh_set);
  view.mesh_index = rows<int32_t>(t[0], "bodies.mesh_index", {kAnySize});
  const int64_t count = t[0].size(0);
  view.centres = {rows<double>(t[1], "bodies.position_t0", {count, 3}),
                  rows<double>(t[2], "bodies.position_t1", {count, 3}), rows<double>(t[3], "bodies.radius", {count}),
                  count};
  if (t.size() > size) view.centres.margin = rows<double>(t[size], "bodies.margin", {count});
  return view;
}

inline RigidBodies rigid_view(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& t, bool linear_path) {
  RigidBodies view = bodies_view<RigidBodies>(mesh_set, t, 6);
  const int64_t count = view.centres.count;
  view.orientation = rows<double>(t[4], "bodies.orientation", {count, 4});
  view.rotation = rows<double>(t[5], "bodies.rotation", {count, 3});
  view.linear_path = linear_path;
  return view;
}

inline DeformingBodies deforming_view(const std::vector<Tensor>& mesh_set, const std::vector<Tensor>& t) {
  DeformingBodies view = bodies_view<DeformingBodies>(mesh_set, t, 11);
  const int64_t count = view.centres.count;
  view.vertex_count = t[4].size(0);
  view.vertices_t0 = rows<double>(t[4], "bodies.vertices_t0", {kAnySize, 3});
  view.vertices_t1 = rows<double>(t[5], "bodies.vertices_t1", {t[4].size(0), 3});
  view.blocks_t0 = rows<float, NodeBlock>(t[6], "bodies.blocks_t0", {kAnySize, kBlockColumns, kBlockWidth});
  view.blocks_t1 = rows<float, NodeBlock>(t[7], "bodies.blocks_t1", {t[6].size(0), kBlockColumns, kBlockWidth});
  view.vertex_begin = rows<int64_t>(t[8], "bodies.vertex_begin", {count});
  view.block_begin = rows<int64_t>(t[9], "bodies.block_begin", {count});
  view.block_count = t[6].size(0);
  view.local_vertices = rows<float, LocalVertex>(t[10], "bodies.local_vertices", {t[4].size(0), 2, 4});
  return view;
}

// Squares of larger lengths overflow.
constexpr double kLargestLength = 1e150;

inline void check_separation(double separation) {
  STD_TORCH_CHECK(separation >= 0.0 && separation <= kLargestLength,
                  "min_separation: expected a length in [0, 1e150], got ", separation);
}

// A negative tolerance is relative to a radius.
inline void check_tolerance(double tolerance) {
  STD_TORCH_CHECK(tolerance >= -1.0 && tolerance <= kLargestLength,
                  "tolerance: expected a length in [0, 1e150], or a fraction of a radius in [-1, 0), got ", tolerance);
}

// The distance up to which a pair may be reported.
struct KeptDistance {
  double separation, tolerance;

  KeptDistance(double min_separation, double given_tolerance) : separation(min_separation), tolerance(given_tolerance) {
    check_separation(separation);
    check_tolerance(tolerance);
  }
};

inline BroadPhaseChoice broad_phase_choice(int64_t broad_phase, int64_t axis) {
  STD_TORCH_CHECK(broad_phase >= 0 && broad_phase < kBroadPhases, "broad_phase: expected a number below ", kBroadPhases,
                  ", got ", broad_phase);
  STD_TORCH_CHECK(axis >= -1 && axis <= 2, "axis: expected 0, 1, 2 or -1 (any), got ", axis);
  return {static_cast<BroadPhase>(broad_phase), static_cast<int>(axis)};
}

inline BroadBodies spheres_view(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
                                const KeptDistance& kept) {
  const double* radii = rows<double>(radius, "radius", {kAnySize});
  const int64_t count = radius.size(0);
  STD_TORCH_CHECK(count < (int64_t{1} << 31), "radius: more than 2^31 - 1 bodies on one device");
  BroadBodies view{};
  view.count = count;
  view.centres = {rows<double>(position_t0, "position_t0", {count, 3}),
                  rows<double>(position_t1, "position_t1", {count, 3}), radii, count};
  view.separation = kept.separation;
  view.tolerance = kept.tolerance;
  return view;
}

// centres = [position_t0 (N, 3), position_t1 (N, 3), radius (N,)]
inline BroadBodies centres_view(const TensorList& centres, const char* name, const KeptDistance& kept) {
  STD_TORCH_CHECK(centres.size() == 3, name, ": expected 3 tensors, got ", centres.size());
  return spheres_view(centres[0], centres[1], centres[2], kept);
}

// Swept bodies: see schemas.cpp.
inline BroadBodies broad_view(const OptionalTensorList& swept, const KeptDistance& kept) {
  STD_TORCH_CHECK(swept.size() >= 3 && swept.size() <= 9, "swept: expected 3 to 9 tensors, got ", swept.size());
  STD_TORCH_CHECK(swept[0] && swept[1] && swept[2], "swept: expected position_t0, position_t1 and radius first");
  const std::optional<Tensor> none;
  const auto at = [&](size_t k) -> const std::optional<Tensor>& { return k < swept.size() ? swept[k] : none; };
  BroadBodies view = spheres_view(*swept[0], *swept[1], *swept[2], kept);
  view.group = optional_column<int64_t>(at(3), "group", view.count);
  view.mask = optional_column<int64_t>(at(4), "mask", view.count);
  view.world = optional_column<int32_t>(at(5), "world", view.count);
  view.is_static = optional_column<uint8_t>(at(6), "is_static", view.count);
  view.in_other_search = optional_column<uint8_t>(at(7), "in_other_search", view.count);
  view.boxes = at(8) ? rows<float, MovingBox>(*at(8), "boxes", {view.count, kMovingBoxColumns}) : nullptr;
  return view;
}

}  // namespace pgccd::bind
