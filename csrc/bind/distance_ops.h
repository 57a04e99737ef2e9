// The distance operators, templates over the session that they run in.
#pragma once

#include "bind/outputs.h"
#include "kernels/distance/distance.h"

namespace pgccd::bind {

using DistanceTensors = std::tuple<Tensor, Tensor, Tensor, Tensor>;

template <class Session>
struct DistanceOps {
  static DistanceTensors distances_rigid(const TensorList& mesh_set, const TensorList& bodies, bool linear_path,
                                         const Tensor& pairs, double cutoff, double tolerance) {
    return distances(rigid_view(mesh_set, bodies, linear_path), pairs, cutoff, tolerance);
  }

  static DistanceTensors distances_deforming(const TensorList& mesh_set, const TensorList& bodies, const Tensor& pairs,
                                             double cutoff, double tolerance) {
    return distances(deforming_view(mesh_set, bodies), pairs, cutoff, tolerance);
  }

 private:
  template <class Bodies>
  static DistanceTensors distances(const Bodies& bodies, const Tensor& pairs, double cutoff, double tolerance) {
    STD_TORCH_CHECK(cutoff >= 0.0, "cutoff: expected a length >= 0, got ", cutoff);
    check_tolerance(tolerance);
    const int64_t count = pairs.size(0);
    const DistanceInput input{rows<int64_t>(pairs, "pairs", {kAnySize, 2}), count, cutoff, tolerance};
    Tensor lower = new_tensor<double>(pairs, {count}), upper = new_tensor<double>(pairs, {count});
    Tensor time = new_tensor<double>(pairs, {count}), points = new_tensor<double>(pairs, {count, 2, 3});
    pgccd::distances(Session(pairs).context(), bodies, input,
                     {data<double>(lower), data<double>(upper), data<double>(time), data<double>(points)});
    return {lower, upper, time, points};
  }
};

template <class Session>
void register_distance_ops(Library& library) {
  using Ops = DistanceOps<Session>;
  library.impl("distances_rigid", PGCCD_BOX(Ops::distances_rigid));
  library.impl("distances_deforming", PGCCD_BOX(Ops::distances_deforming));
}

}  // namespace pgccd::bind
