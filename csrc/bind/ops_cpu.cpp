// CPU implementations of the operators: views in, kernels, tensors out.
#include <cstring>

#include "bind/arguments.h"
#include "bind/cpu_executor.h"
#include "kernels/broad/sweep.h"
#include "kernels/narrow/narrow.h"
#include "kernels/traverse/traverse.h"

namespace pgccd::bind {
namespace {

using TensorList = std::vector<Tensor>;
using ContactTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

template <class T>
Tensor new_tensor(const Tensor& like, std::initializer_list<int64_t> shape) {
  const std::vector<int64_t> sizes(shape);
  return torch::stable::new_empty(like, sizes, scalar_type_of<T>());
}

template <class T>
T* data(Tensor& tensor) {
  return static_cast<T*>(tensor.data_ptr());
}

template <class Element, class Row>
Tensor to_tensor(const Tensor& like, const std::vector<Row>& values, std::initializer_list<int64_t> shape) {
  Tensor out = new_tensor<Element>(like, shape);
  if (!values.empty()) std::memcpy(out.data_ptr(), values.data(), values.size() * sizeof(Row));
  return out;
}

Tensor rotations_between(const Tensor& orientation_t0, const Tensor& orientation_t1) {
  const double* q0 = rows<double>(orientation_t0, "orientation_t0", {kAnySize, 4});
  const int64_t count = orientation_t0.size(0);
  const double* q1 = rows<double>(orientation_t1, "orientation_t1", {count, 4});
  Tensor rotation = new_tensor<double>(orientation_t0, {count, 3});
  rotations_between_cpu(TorchExecutor(), q0, q1, count, data<double>(rotation));
  return rotation;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> refit(const TensorList& mesh_set, const Tensor& mesh_index,
                                                         const Tensor& vertices_t0, const Tensor& vertices_t1,
                                                         const Tensor& vertex_begin, const Tensor& block_begin,
                                                         int64_t block_count) {
  DeformingInput input;
  input.meshes = mesh_set_view(mesh_set);
  input.mesh_index = rows<int32_t>(mesh_index, "mesh_index", {kAnySize});
  input.body_count = mesh_index.size(0);
  input.vertices_t0 = rows<double>(vertices_t0, "vertices_t0", {kAnySize, 3});
  input.vertices_t1 = rows<double>(vertices_t1, "vertices_t1", {vertices_t0.size(0), 3});
  input.vertex_begin = rows<int64_t>(vertex_begin, "vertex_begin", {input.body_count});
  input.block_begin = rows<int64_t>(block_begin, "block_begin", {input.body_count});
  Tensor position_t0 = new_tensor<double>(vertices_t0, {input.body_count, 3});
  Tensor position_t1 = new_tensor<double>(vertices_t0, {input.body_count, 3});
  Tensor radius = new_tensor<double>(vertices_t0, {input.body_count});
  Tensor blocks_t0 = new_tensor<float>(vertices_t0, {block_count, 4, kBlockWidth});
  Tensor blocks_t1 = new_tensor<float>(vertices_t0, {block_count, 4, kBlockWidth});
  refit_cpu(TorchExecutor(), input,
            {data<double>(position_t0), data<double>(position_t1), data<double>(radius), data<NodeBlock>(blocks_t0),
             data<NodeBlock>(blocks_t1)});
  return {position_t0, position_t1, radius, blocks_t0, blocks_t1};
}

Tensor sweep(const Tensor& position_t0, const Tensor& position_t1, const Tensor& radius,
             const std::optional<Tensor>& group, const std::optional<Tensor>& mask, const std::optional<Tensor>& world,
             const std::optional<Tensor>& is_static, double min_separation, int64_t axis) {
  const BroadBodies bodies =
      broad_view(position_t0, position_t1, radius, group, mask, world, is_static, min_separation);
  const std::vector<BodyPair> pairs = sweep_cpu(TorchExecutor(), bodies, static_cast<int>(axis));
  return to_tensor<int64_t>(radius, pairs, {static_cast<int64_t>(pairs.size()), 2});
}

template <class Bodies>
std::tuple<Tensor, Tensor> traverse(const Bodies& bodies, const Tensor& pairs, const std::optional<Tensor>& horizon,
                                    double min_separation, double tolerance, bool leading) {
  TraverseInput input;
  input.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
  input.pair_count = pairs.size(0);
  STD_TORCH_CHECK(input.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
  input.horizon = optional_column<double>(horizon, "horizon", input.pair_count);
  input.settings = {min_separation, tolerance};
  input.leading = leading;
  const CandidateList list = traverse_cpu(TorchExecutor(), bodies, input);
  Tensor candidates = new_tensor<int32_t>(pairs, {list.size(), 4});
  Candidate* out = data<Candidate>(candidates);
  for (const auto& part : list.parts) out = std::copy(part.begin(), part.end(), out);
  Tensor node_tests = new_tensor<int64_t>(pairs, {1});
  *data<int64_t>(node_tests) = list.node_tests;
  return {candidates, node_tests};
}

std::tuple<Tensor, Tensor> traverse_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                          const Tensor& pairs, const std::optional<Tensor>& horizon,
                                          double min_separation, double tolerance, bool leading) {
  return traverse(rigid_view(mesh_set, bodies, linear_path), pairs, horizon, min_separation, tolerance, leading);
}

std::tuple<Tensor, Tensor> traverse_deforming(const TensorList& mesh_set, const TensorList& bodies, const Tensor& pairs,
                                              const std::optional<Tensor>& horizon, double min_separation,
                                              double tolerance, bool leading) {
  return traverse(deforming_view(mesh_set, bodies), pairs, horizon, min_separation, tolerance, leading);
}

template <class Bodies>
ContactTensors narrow(const Bodies& bodies, const Tensor& pairs, const Tensor& candidates, double min_separation,
                      double tolerance, bool nonzero_toi, int64_t report) {
  NarrowInput input;
  input.candidates = rows<int32_t, Candidate>(candidates, "candidates", {kAnySize, 4});
  input.candidate_count = candidates.size(0);
  input.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
  input.pair_count = pairs.size(0);
  input.settings = {min_separation, tolerance, nonzero_toi};
  STD_TORCH_CHECK(report >= 0 && report <= 3, "report: expected 0 (any), 1 (first), 2 (all) or 3 (earliest), got ",
                  report);
  input.report = static_cast<Report>(report);
  const ContactRows found = narrow_phase_cpu(TorchExecutor(), bodies, input);
  const int64_t count = static_cast<int64_t>(found.pair.size());
  Tensor kind = torch::stable::new_empty(pairs, {count}, ScalarType::Char);
  Tensor status = torch::stable::new_empty(pairs, {count}, ScalarType::Char);
  if (count > 0) {
    std::memcpy(kind.data_ptr(), found.kind.data(), count);
    std::memcpy(status.data_ptr(), found.status.data(), count);
  }
  return {
      to_tensor<int32_t>(pairs, found.pair, {count}),        kind,
      to_tensor<int32_t>(pairs, found.features, {count, 2}), status,
      to_tensor<double>(pairs, found.toi, {count}),          to_tensor<double>(pairs, found.coordinates, {count, 2}),
      to_tensor<double>(pairs, found.point, {count, 3}),     to_tensor<double>(pairs, found.normal, {count, 3})};
}

ContactTensors narrow_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path, const Tensor& pairs,
                            const Tensor& candidates, double min_separation, double tolerance, bool nonzero_toi,
                            int64_t report) {
  return narrow(rigid_view(mesh_set, bodies, linear_path), pairs, candidates, min_separation, tolerance, nonzero_toi,
                report);
}

ContactTensors narrow_deforming(const TensorList& mesh_set, const TensorList& bodies, const Tensor& pairs,
                                const Tensor& candidates, double min_separation, double tolerance, bool nonzero_toi,
                                int64_t report) {
  return narrow(deforming_view(mesh_set, bodies), pairs, candidates, min_separation, tolerance, nonzero_toi, report);
}

template <bool kEdgeEdge>
std::tuple<Tensor, Tensor, Tensor> elementary(const Tensor& points_t0, const Tensor& points_t1, double min_separation,
                                              double tolerance, bool nonzero_toi) {
  const double* x0 = rows<double>(points_t0, "points_t0", {kAnySize, 4, 3});
  const int64_t count = points_t0.size(0);
  const double* x1 = rows<double>(points_t1, "points_t1", {count, 4, 3});
  Tensor status = torch::stable::new_empty(points_t0, {count}, ScalarType::Char);
  Tensor toi = new_tensor<double>(points_t0, {count});
  Tensor coordinates = new_tensor<double>(points_t0, {count, 2});
  elementary_cpu<kEdgeEdge>(TorchExecutor(), x0, x1, count, {min_separation, tolerance, nonzero_toi},
                            data<int8_t>(status), data<double>(toi), data<double>(coordinates));
  return {status, toi, coordinates};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(pgccd, CPU, library) {
  library.impl("rotations_between", TORCH_BOX(&rotations_between));
  library.impl("refit", TORCH_BOX(&refit));
  library.impl("sweep", TORCH_BOX(&sweep));
  library.impl("traverse_rigid", TORCH_BOX(&traverse_rigid));
  library.impl("traverse_deforming", TORCH_BOX(&traverse_deforming));
  library.impl("narrow_rigid", TORCH_BOX(&narrow_rigid));
  library.impl("narrow_deforming", TORCH_BOX(&narrow_deforming));
  library.impl("vertex_face", TORCH_BOX(&elementary<false>));
  library.impl("edge_edge", TORCH_BOX(&elementary<true>));
}

}  // namespace pgccd::bind
