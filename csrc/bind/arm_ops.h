// The operators of robots, templates over the session that they run in.
#pragma once

#include "bind/outputs.h"
#include "kernels/arms/certify.h"
#include "kernels/arms/kinematics.h"
#include "kernels/arms/scene_checks.h"

namespace pgccd::bind {

// joints, places, crossing, chain_begin, chain, body_reach: see kernels/arms/arm.h.
inline Arm arm_view(const TensorList& t, double room) {
  STD_TORCH_CHECK(t.size() == 6, "arm: expected 6 tensors, got ", t.size());
  Arm arm{};
  arm.joints = rows<int32_t, Joint>(t[0], "arm.joints", {kAnySize, kJointColumns});
  arm.joint_count = t[0].size(0);
  arm.places = rows<double, JointPlace>(t[1], "arm.places", {arm.joint_count, kPlaceColumns});
  arm.crossing = rows<double>(t[2], "arm.crossing", {arm.joint_count, arm.joint_count});
  arm.chain_begin = rows<int32_t>(t[3], "arm.chain_begin", {kAnySize});
  arm.body_count = t[3].size(0) - 1;
  STD_TORCH_CHECK(arm.body_count >= 0, "arm.chain_begin: expected at least one row");
  arm.chain = rows<int32_t>(t[4], "arm.chain", {kAnySize});
  arm.body_reach = rows<double>(t[5], "arm.body_reach", {arm.body_count});
  arm.room = room;
  return arm;
}

// position_t0, position_t1, orientation, rotation, error.
inline ArmObstacles obstacles_view(const TensorList& t, bool move) {
  STD_TORCH_CHECK(t.size() == 5, "obstacles: expected 5 tensors, got ", t.size());
  ArmObstacles view{};
  view.position_t0 = rows<double>(t[0], "obstacles.position_t0", {kAnySize, kAnySize, 3});
  view.row_count = t[0].size(0);
  view.count = t[0].size(1);
  view.position_t1 = rows<double>(t[1], "obstacles.position_t1", {view.row_count, view.count, 3});
  view.orientation = rows<double>(t[2], "obstacles.orientation", {view.row_count, view.count, 4});
  view.rotation = rows<double>(t[3], "obstacles.rotation", {view.row_count, view.count, 3});
  view.error = rows<double>(t[4], "obstacles.error", {view.count});
  view.move = move;
  return view;
}

// bodies: mesh_index, radius, margin; pairs (., 3).
inline ArmScene arm_scene_view(const TensorList& mesh_set, const TensorList& arm, const TensorList& bodies,
                               const TensorList& obstacles, bool obstacles_move, double room) {
  STD_TORCH_CHECK(bodies.size() == 4, "bodies: expected 4 tensors, got ", bodies.size());
  ArmScene scene{};
  scene.arm = arm_view(arm, room);
  scene.obstacles = obstacles_view(obstacles, obstacles_move);
  scene.meshes = mesh_set_view(mesh_set);
  const int64_t count = scene.arm.body_count + scene.obstacles.count;
  scene.mesh_index = rows<int32_t>(bodies[0], "bodies.mesh_index", {count});
  scene.radius = rows<double>(bodies[1], "bodies.radius", {count});
  scene.margin = rows<double>(bodies[2], "bodies.margin", {count});
  scene.pairs = rows<int32_t, ArmPair>(bodies[3], "bodies.pairs", {kAnySize, kArmPairColumns});
  scene.pair_count = bodies[3].size(0);
  return scene;
}

// control (paths, control points, coordinates).
inline ArmPaths paths_view(const Tensor& control, int64_t degree, double error) {
  const double* const q = rows<double>(control, "control", {kAnySize, kAnySize, kAnySize});
  STD_TORCH_CHECK(degree >= 1 && degree <= kMostDegree, "degree: expected 1 to ", kMostDegree, ", got ", degree);
  STD_TORCH_CHECK(error >= 0.0 && error <= kLargestJointValue, "error: expected a number in [0, 1e6], got ", error);
  const int64_t count = control.size(1);
  STD_TORCH_CHECK(count > degree && (count - 1) % degree == 0, "control: expected a multiple of ", degree,
                  " and one control points, got ", count);
  return {q, control.size(0), count, static_cast<int32_t>(degree), error};
}

template <class Session>
struct ArmOps {
  static std::tuple<Tensor, Tensor> arm_poses(const TensorList& arm, const Tensor& q) {
    Arm view = arm_view(arm, 0.0);
    const double* const configurations = rows<double>(q, "q", {kAnySize, kAnySize});
    view.coordinate_count = q.size(1);
    check(view, arm);
    const int64_t count = q.size(0);
    Tensor position = new_tensor<double>(q, {count, view.body_count, 3});
    Tensor orientation = new_tensor<double>(q, {count, view.body_count, 4});
    pgccd::arm_poses(Session(q).context(), view, configurations, count,
                     {data<double>(position), data<double>(orientation)});
    return {position, orientation};
  }

  using Arcs = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

  static Arcs arm_arcs(const TensorList& arm, const Tensor& control, double error, const Tensor& begin,
                       const Tensor& end) {
    Arm view = arm_view(arm, 0.0);
    const ArmPaths paths = paths_view(control, control.size(1) - 1, error);
    view.coordinate_count = control.size(2);
    const int64_t count = paths.path_count, bodies = view.body_count;
    const ArmSpans spans{paths, rows<double>(begin, "begin", {count}), rows<double>(end, "end", {count})};
    check(view, arm);
    Tensor position_t0 = new_tensor<double>(control, {count, bodies, 3});
    Tensor position_t1 = new_tensor<double>(control, {count, bodies, 3});
    Tensor orientation = new_tensor<double>(control, {count, bodies, 4});
    Tensor rotation = new_tensor<double>(control, {count, bodies, 3});
    Tensor stray = new_tensor<double>(control, {count, bodies});
    pgccd::arm_arcs(Session(control).context(), view, spans,
                    {{data<double>(position_t0), data<double>(orientation)},
                     data<double>(position_t1),
                     data<double>(rotation),
                     data<double>(stray)});
    return {position_t0, position_t1, orientation, rotation, stray};
  }

  using Verdicts = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static Verdicts certify_paths(const TensorList& mesh_set, const TensorList& arm, const TensorList& bodies,
                                const TensorList& obstacles, bool obstacles_move, double room, const Tensor& control,
                                int64_t degree, double error, double resolution) {
    ArmScene scene = arm_scene_view(mesh_set, arm, bodies, obstacles, obstacles_move, room);
    const ArmPaths paths = paths_view(control, degree, error);
    scene.arm.coordinate_count = control.size(2);
    check(scene, arm);
    STD_TORCH_CHECK(resolution > 0.0 && resolution <= kLargestLength,
                    "resolution: expected a length in (0, 1e150], got ", resolution);
    const int64_t rows_needed =
        scene.obstacles.move ? paths.segment_count() : (scene.obstacles.row_count == 1 ? 1 : paths.path_count);
    STD_TORCH_CHECK(scene.obstacles.row_count == rows_needed, "obstacles: expected ", rows_needed, " rows, got ",
                    scene.obstacles.row_count);
    const int64_t count = paths.path_count;
    Tensor verdict = new_tensor<int8_t>(control, {count}), segment = new_tensor<int64_t>(control, {count});
    Tensor toi = new_tensor<double>(control, {count}), both = new_tensor<int32_t>(control, {count, 2});
    Tensor point = new_tensor<double>(control, {count, 3});
    Tensor counts = new_tensor<int64_t>(control, {count, int64_t{kArmCounts}});
    pgccd::certify(Session(control).context(), scene, paths, resolution,
                   {data<int8_t>(verdict), data<int64_t>(segment), data<double>(toi), data<int32_t>(both),
                    data<double>(point), data<int64_t>(counts)});
    return {verdict, segment, toi, both, point, counts};
  }

 private:
  // On a GPU the host does not wait for checks of values.
  template <class View>
  static void check(const View& view, const TensorList& arm) {
    if (!arm[0].is_cuda()) require_sound(view, arm[4].size(0));
  }
};

template <class Session>
void register_arm_ops(Library& library) {
  using Ops = ArmOps<Session>;
  library.impl("arm_poses", PGCCD_BOX(Ops::arm_poses));
  library.impl("arm_arcs", PGCCD_BOX(Ops::arm_arcs));
  library.impl("certify_paths", PGCCD_BOX(Ops::certify_paths));
}

}  // namespace pgccd::bind
