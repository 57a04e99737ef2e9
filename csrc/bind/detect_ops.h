// The detection operators, templates over the session that they run in: views in, kernels, tensors out. Outputs whose
// size only the kernel determines are allocated by a callback.
#pragma once

#include "bind/outputs.h"
#include "core/candidate.h"
#include "kernels/bounds/bounds.h"
#include "kernels/bounds/validation.h"
#include "kernels/broad/broad.h"
#include "kernels/narrow/narrow.h"
#include "kernels/traverse/traverse.h"

namespace pgccd::bind {

inline SweepSettings sweep_settings(double min_separation, double tolerance, bool tests_start) {
  const KeptDistance kept(min_separation, tolerance);
  return {kept.separation, kept.tolerance, tests_start};
}

inline Report report_of(int64_t report) {
  STD_TORCH_CHECK(report >= 0 && report < kReports, "report: expected a number below ", kReports, ", got ", report);
  return static_cast<Report>(report);
}

using ElementaryTensors = std::tuple<Tensor, Tensor, Tensor, Tensor>;

template <class Session>
struct DetectOps {
  static Tensor first_invalid_rows(const TensorList& columns, const std::vector<int64_t>& checks,
                                   const std::vector<double>& limits) {
    STD_TORCH_CHECK(!columns.empty() && checks.size() == columns.size() && limits.size() == columns.size(),
                    "columns: expected equal numbers of checks and limits, at least one");
    std::vector<RowColumn> views;
    for (size_t k = 0; k < columns.size(); ++k) {
      const double* values = rows<double>(columns[k], "columns", {kAnySize, kAnySize});
      const auto width = static_cast<int32_t>(columns[k].size(1));
      STD_TORCH_CHECK(checks[k] >= 0 && checks[k] <= 4,
                      "checks: expected 0 (magnitude), 1 (unit length), 2 (length), 3 (range) or 4 (size), got ",
                      checks[k]);
      views.push_back({values, columns[k].size(0), width, static_cast<RowCheck>(checks[k]), limits[k]});
    }
    Tensor first = new_tensor<int64_t>(columns[0], {static_cast<int64_t>(columns.size()) + 1});
    pgccd::first_invalid_rows(Session(columns[0]).context(), views, {}, data<int64_t>(first));
    return first;
  }

  // The radii of rigid bodies, and the first invalid rows of the four columns of their motion, of mesh_index unless
  // radii are given, and of margin if there is one.
  static std::tuple<Tensor, Tensor> sound_radii(const Tensor& of_meshes, const Tensor& mesh_index,
                                                const std::optional<Tensor>& given, const Tensor& position_t0,
                                                const Tensor& position_t1, const Tensor& orientation,
                                                const Tensor& rotation, const std::optional<Tensor>& margin) {
    const int64_t count = mesh_index.size(0), mesh_count = of_meshes.size(0);
    const int32_t* const meshes = rows<int32_t>(mesh_index, "mesh_index", {kAnySize});
    std::vector<RowColumn> columns{
        {rows<double>(position_t0, "position_t0", {count, 3}), count, 3, RowCheck::kMagnitude, kLargestCoordinate},
        {rows<double>(position_t1, "position_t1", {count, 3}), count, 3, RowCheck::kMagnitude, kLargestCoordinate},
        {rows<double>(orientation, "orientation", {count, 4}), count, 4, RowCheck::kUnitLength, kUnitTolerance},
        {rows<double>(rotation, "rotation", {count, 3}), count, 3, RowCheck::kLength, kLargestTurn}};
    if (!given) columns.push_back({nullptr, count, 1, RowCheck::kRange, mesh_count - 1.0, meshes});
    if (margin) {
      columns.push_back({rows<double>(*margin, "margin", {count}), count, 1, RowCheck::kRange, kLargestCoordinate});
    }
    Tensor radius = new_tensor<double>(position_t0, {count});
    Tensor first = new_tensor<int64_t>(position_t0, {static_cast<int64_t>(columns.size()) + 1});
    const SoundRadii radii{optional_column<double>(given, "given", count),
                           rows<double>(of_meshes, "of_meshes", {kAnySize}),
                           meshes,
                           mesh_count,
                           data<double>(radius),
                           count};
    pgccd::first_invalid_rows(Session(position_t0).context(), columns, radii, data<int64_t>(first));
    return {radius, first};
  }

  static Tensor rotations_between(const Tensor& orientation_t0, const Tensor& orientation_t1) {
    const double* q0 = rows<double>(orientation_t0, "orientation_t0", {kAnySize, 4});
    const int64_t count = orientation_t0.size(0);
    const double* q1 = rows<double>(orientation_t1, "orientation_t1", {count, 4});
    Tensor rotation = new_tensor<double>(orientation_t0, {count, 3});
    pgccd::rotations_between(Session(orientation_t0).context(), q0, q1, count, data<double>(rotation));
    return rotation;
  }

  static std::tuple<Tensor, Tensor> poses_at(const Tensor& position_t0, const Tensor& position_t1,
                                             const Tensor& orientation, const Tensor& rotation, const Tensor& time) {
    const double* times = rows<double>(time, "time", {kAnySize});
    const int64_t count = time.size(0);
    const RigidPoses poses{
        rows<double>(position_t0, "position_t0", {count, 3}), rows<double>(position_t1, "position_t1", {count, 3}),
        rows<double>(orientation, "orientation", {count, 4}), rows<double>(rotation, "rotation", {count, 3}), times};
    Tensor position = new_tensor<double>(time, {count, 3}), turned = new_tensor<double>(time, {count, 4});
    pgccd::poses_at(Session(time).context(), poses, count, data<double>(position), data<double>(turned));
    return {position, turned};
  }

  static std::tuple<Tensor, Tensor> shorten_arcs(const Tensor& position_t0, const Tensor& position_t1,
                                                 const Tensor& rotation, const Tensor& fraction) {
    ShortenedArcs arcs;
    arcs.fraction = rows<double>(fraction, "fraction", {kAnySize});
    const int64_t count = fraction.size(0);
    arcs.position_t0 = rows<double>(position_t0, "position_t0", {count, 3});
    arcs.position_t1 = rows<double>(position_t1, "position_t1", {count, 3});
    arcs.rotation = rows<double>(rotation, "rotation", {count, 3});
    Tensor end = new_tensor<double>(fraction, {count, 3}), turn = new_tensor<double>(fraction, {count, 3});
    arcs.end = data<double>(end);
    arcs.turn = data<double>(turn);
    pgccd::shorten_arcs(Session(fraction).context(), arcs, count);
    return {end, turn};
  }

  static std::tuple<Tensor, Tensor, Tensor> moving_spheres(const TensorList& mesh_set, const TensorList& bodies,
                                                           bool linear_path) {
    const RigidBodies view = rigid_view(mesh_set, bodies, linear_path);
    const Tensor& like = bodies[1];
    const int64_t count = like.size(0);
    Tensor centre_t0 = new_tensor<double>(like, {count, 3}), centre_t1 = new_tensor<double>(like, {count, 3});
    Tensor reach = new_tensor<double>(like, {count});
    pgccd::moving_spheres(Session(like).context(), view, count,
                          {data<double>(centre_t0), data<double>(centre_t1), data<double>(reach)});
    return {centre_t0, centre_t1, reach};
  }

  static Tensor moving_boxes_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path) {
    return moving_boxes(rigid_view(mesh_set, bodies, linear_path), bodies[1]);
  }

  static Tensor moving_boxes_deforming(const TensorList& mesh_set, const TensorList& bodies) {
    return moving_boxes(deforming_view(mesh_set, bodies), bodies[1]);
  }

  static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> refit(
      const TensorList& mesh_set, const Tensor& mesh_index, const Tensor& vertices_t0, const Tensor& vertices_t1,
      const Tensor& vertex_begin, const Tensor& block_begin, int64_t block_count) {
    DeformingInput input;
    input.meshes = mesh_set_view(mesh_set);
    input.mesh_index = rows<int32_t>(mesh_index, "mesh_index", {kAnySize});
    input.body_count = mesh_index.size(0);
    input.vertices_t0 = rows<double>(vertices_t0, "vertices_t0", {kAnySize, 3});
    input.vertex_count = vertices_t0.size(0);
    input.vertices_t1 = rows<double>(vertices_t1, "vertices_t1", {vertices_t0.size(0), 3});
    input.vertex_begin = rows<int64_t>(vertex_begin, "vertex_begin", {input.body_count});
    input.block_begin = rows<int64_t>(block_begin, "block_begin", {input.body_count});
    STD_TORCH_CHECK(block_count >= 0 && block_count < (int64_t{1} << 31),
                    "block_count: expected a number in [0, 2^31), got ", block_count);
    input.block_count = block_count;
    Tensor position_t0 = new_tensor<double>(vertices_t0, {input.body_count, 3});
    Tensor position_t1 = new_tensor<double>(vertices_t0, {input.body_count, 3});
    Tensor radius = new_tensor<double>(vertices_t0, {input.body_count});
    Tensor blocks_t0 = new_tensor<float>(vertices_t0, {block_count, kBlockColumns, kBlockWidth});
    Tensor blocks_t1 = new_tensor<float>(vertices_t0, {block_count, kBlockColumns, kBlockWidth});
    Tensor local_vertices = new_tensor<float>(vertices_t0, {input.vertex_count, 2, 4});
    pgccd::refit(Session(vertices_t0).context(), input,
                 {data<double>(position_t0), data<double>(position_t1), data<double>(radius),
                  data<NodeBlock>(blocks_t0), data<NodeBlock>(blocks_t1), data<LocalVertex>(local_vertices)});
    return {position_t0, position_t1, radius, blocks_t0, blocks_t1, local_vertices};
  }

  static Tensor broad_pairs(const OptionalTensorList& swept, double min_separation, double tolerance,
                            int64_t broad_phase, int64_t axis, bool at_any_times) {
    const BroadPhaseChoice choice = broad_phase_choice(broad_phase, axis);
    BroadBodies bodies = broad_view(swept, {min_separation, tolerance});
    bodies.at_any_times = at_any_times;
    const Tensor& like = *swept[0];
    Tensor pairs = like;
    const auto make_rows = [&](int64_t count) { return data<int64_t>(pairs = new_tensor<int64_t>(like, {count, 2})); };
    pgccd::find_pairs(Session(like).context(), bodies, choice, PairOutput(make_rows));
    return pairs;
  }

  static std::tuple<Tensor, Tensor> meeting_pairs(const Tensor& pairs, const OptionalTensorList& swept,
                                                  double min_separation, double tolerance) {
    const SweptPairs known{broad_view(swept, {min_separation, tolerance}), rows<int64_t>(pairs, "pairs", {kAnySize, 2}),
                           pairs.size(0)};
    Tensor meeting = new_tensor<int64_t>(pairs, {pairs.size(0), 2}), found = new_tensor<int64_t>(pairs, {1});
    pgccd::meeting_pairs(Session(pairs).context(), known, data<int64_t>(meeting), data<int64_t>(found));
    return {meeting, found};
  }

  static std::tuple<Tensor, Tensor> traverse_rigid(const TensorList& mesh_set, const TensorList& bodies,
                                                   bool linear_path, const Tensor& pairs,
                                                   const std::optional<Tensor>& horizon, double min_separation,
                                                   double tolerance, bool tests_start) {
    return traverse(rigid_view(mesh_set, bodies, linear_path), pairs, horizon,
                    sweep_settings(min_separation, tolerance, tests_start));
  }

  static std::tuple<Tensor, Tensor> traverse_deforming(const TensorList& mesh_set, const TensorList& bodies,
                                                       const Tensor& pairs, const std::optional<Tensor>& horizon,
                                                       double min_separation, double tolerance, bool tests_start) {
    return traverse(deforming_view(mesh_set, bodies), pairs, horizon,
                    sweep_settings(min_separation, tolerance, tests_start));
  }

  static ContactTensors narrow_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                     const Tensor& pairs, const Tensor& candidates, double min_separation,
                                     double tolerance, bool nonzero_toi, int64_t report) {
    return narrow(rigid_view(mesh_set, bodies, linear_path), pairs, candidates,
                  {min_separation, tolerance, nonzero_toi}, report);
  }

  static ContactTensors narrow_deforming(const TensorList& mesh_set, const TensorList& bodies, const Tensor& pairs,
                                         const Tensor& candidates, double min_separation, double tolerance,
                                         bool nonzero_toi, int64_t report) {
    return narrow(deforming_view(mesh_set, bodies), pairs, candidates, {min_separation, tolerance, nonzero_toi},
                  report);
  }

  template <FeatureKind kKind>
  static ElementaryTensors elementary(const Tensor& points_t0, const Tensor& points_t1, double min_separation,
                                      double tolerance, bool nonzero_toi) {
    check_separation(min_separation);
    check_tolerance(tolerance);
    STD_TORCH_CHECK(tolerance >= 0.0, "tolerance: expected a length >= 0, got ", tolerance);
    const NarrowSettings settings{min_separation, tolerance, nonzero_toi};
    if (points_t0.scalar_type() == ScalarType::Float) {
      return elementary_in<kKind, float>(points_t0, points_t1, settings);
    }
    return elementary_in<kKind, double>(points_t0, points_t1, settings);
  }

 private:
  template <class Bodies>
  static Tensor moving_boxes(const Bodies& bodies, const Tensor& like) {
    Tensor boxes = new_tensor<float>(like, {bodies.centres.count, kMovingBoxColumns});
    pgccd::moving_boxes(Session(like).context(), bodies, data<MovingBox>(boxes));
    return boxes;
  }

  template <class Bodies>
  static std::tuple<Tensor, Tensor> traverse(const Bodies& bodies, const Tensor& pairs,
                                             const std::optional<Tensor>& horizon, const SweepSettings& settings) {
    TraverseInput input;
    input.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
    input.pair_count = pairs.size(0);
    STD_TORCH_CHECK(input.pair_count < (int64_t{1} << 31), "pairs: more than 2^31 - 1 rows in one call");
    input.horizon = optional_column<double>(horizon, "horizon", input.pair_count);
    input.settings = settings;
    Tensor candidates = pairs;
    Tensor node_tests = new_tensor<int64_t>(pairs, {1});
    const auto make_candidates = [&](int64_t count) {
      candidates = new_tensor<int32_t>(pairs, {count, 4});
      return data<Candidate>(candidates);
    };
    pgccd::traverse(Session(pairs).context(), bodies, input, make_candidates, data<int64_t>(node_tests));
    return {candidates, node_tests};
  }

  template <class Bodies>
  static ContactTensors narrow(const Bodies& bodies, const Tensor& pairs, const Tensor& candidates,
                               const NarrowSettings& settings, int64_t report) {
    NarrowInput input;
    check_separation(settings.separation);
    check_tolerance(settings.tolerance);
    input.candidates.items = rows<int32_t, Candidate>(candidates, "candidates", {kAnySize, 4});
    input.candidates.size = candidates.size(0);
    STD_TORCH_CHECK(input.candidates.size < (int64_t{1} << 31), "candidates: more than 2^31 - 1 rows in one call");
    input.pairs = rows<int64_t>(pairs, "pairs", {kAnySize, 2});
    input.pair_count = pairs.size(0);
    input.settings = settings;
    input.report = report_of(report);
    ContactTensors out{pairs, pairs, pairs, pairs, pairs, pairs, pairs, pairs};
    pgccd::narrow_phase(Session(pairs).context(), bodies, input, [&](int64_t count) {
      out = new_contact_tensors(pairs, count);
      return contact_columns(out);
    });
    return out;
  }

  template <FeatureKind kKind, class T>
  static ElementaryTensors elementary_in(const Tensor& points_t0, const Tensor& points_t1,
                                         const NarrowSettings& settings) {
    const T* x0 = rows<T>(points_t0, "points_t0", {kAnySize, 4, 3});
    const int64_t count = points_t0.size(0);
    const T* x1 = rows<T>(points_t1, "points_t1", {count, 4, 3});
    Tensor status = new_tensor<int8_t>(points_t0, {count});
    Tensor toi = new_tensor<T>(points_t0, {count});
    Tensor coordinates = new_tensor<T>(points_t0, {count, 2});
    Tensor significant_bits = new_tensor<int8_t>(points_t0, {count});
    const ElementaryColumns<T> out{data<int8_t>(status), data<T>(toi), data<T>(coordinates),
                                   data<int8_t>(significant_bits)};
    pgccd::elementary<kKind>(Session(points_t0).context(), x0, x1, count, settings, out);
    return {status, toi, coordinates, significant_bits};
  }
};

template <class Session>
void register_detect_ops(Library& library) {
  using Ops = DetectOps<Session>;
  library.impl("first_invalid_rows", PGCCD_BOX(Ops::first_invalid_rows));
  library.impl("sound_radii", PGCCD_BOX(Ops::sound_radii));
  library.impl("rotations_between", PGCCD_BOX(Ops::rotations_between));
  library.impl("poses_at", PGCCD_BOX(Ops::poses_at));
  library.impl("shorten_arcs", PGCCD_BOX(Ops::shorten_arcs));
  library.impl("moving_spheres", PGCCD_BOX(Ops::moving_spheres));
  library.impl("moving_boxes_rigid", PGCCD_BOX(Ops::moving_boxes_rigid));
  library.impl("moving_boxes_deforming", PGCCD_BOX(Ops::moving_boxes_deforming));
  library.impl("refit", PGCCD_BOX(Ops::refit));
  library.impl("broad_pairs", PGCCD_BOX(Ops::broad_pairs));
  library.impl("meeting_pairs", PGCCD_BOX(Ops::meeting_pairs));
  library.impl("traverse_rigid", PGCCD_BOX(Ops::traverse_rigid));
  library.impl("traverse_deforming", PGCCD_BOX(Ops::traverse_deforming));
  library.impl("narrow_rigid", PGCCD_BOX(Ops::narrow_rigid));
  library.impl("narrow_deforming", PGCCD_BOX(Ops::narrow_deforming));
  library.impl("vertex_face", PGCCD_BOX(Ops::template elementary<FeatureKind::kVertexFace>));
  library.impl("edge_edge", PGCCD_BOX(Ops::template elementary<FeatureKind::kEdgeEdge>));
}

}  // namespace pgccd::bind
