// The operators of poses on a path and of the broad phase's spheres, written once for both backends.
#pragma once

#include <tuple>
#include <vector>

#include "bind/outputs.h"
#include "kernels/bounds/bounds.h"

namespace pgccd::bind {

template <class Backend>
struct BoundsOps {
  static std::tuple<Tensor, Tensor> poses_at(const Tensor& position_t0, const Tensor& position_t1,
                                             const Tensor& orientation, const Tensor& rotation, const Tensor& time) {
    const double* times = rows<double>(time, "time", {kAnySize});
    const int64_t count = time.size(0);
    const RigidPoses poses{
        rows<double>(position_t0, "position_t0", {count, 3}), rows<double>(position_t1, "position_t1", {count, 3}),
        rows<double>(orientation, "orientation", {count, 4}), rows<double>(rotation, "rotation", {count, 3}), times};
    Tensor position = new_tensor<double>(time, {count, 3}), turned = new_tensor<double>(time, {count, 4});
    Backend(time).poses_at(poses, count, data<double>(position), data<double>(turned));
    return {position, turned};
  }

  static std::tuple<Tensor, Tensor, Tensor> moving_spheres(const std::vector<Tensor>& mesh_set,
                                                           const std::vector<Tensor>& bodies, bool linear_path) {
    const RigidBodies view = rigid_view(mesh_set, bodies, linear_path);
    const Tensor& like = bodies[1];
    const int64_t count = like.size(0);
    Tensor centre_t0 = new_tensor<double>(like, {count, 3}), centre_t1 = new_tensor<double>(like, {count, 3});
    Tensor reach = new_tensor<double>(like, {count});
    Backend(like).moving_spheres(view, count, {data<double>(centre_t0), data<double>(centre_t1), data<double>(reach)});
    return {centre_t0, centre_t1, reach};
  }
};

// Use inside a STABLE_TORCH_LIBRARY_IMPL block.
#define PGCCD_REGISTER_BOUNDS_OPS(library, Backend)                                       \
  library.impl("poses_at", TORCH_BOX(&OnOneDevice<&BoundsOps<Backend>::poses_at>::call)); \
  library.impl("moving_spheres", TORCH_BOX(&OnOneDevice<&BoundsOps<Backend>::moving_spheres>::call))

}  // namespace pgccd::bind
