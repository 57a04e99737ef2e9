// The operators of the nanorobot simulation.
//
// state = [id (N,) i64, position (N, 3), orientation (N, 4), velocity (N, 3), angular_velocity (N, 3), target (N,) i64,
//          stay_until (N,) i64], see kernels/simulate/robot.h
// integers, scales: WorldIntegers and WorldScales of kernels/simulate/world.h
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY_FRAGMENT(pgccd, library) {
  library.def(
      "simulate_start(Tensor id, int[] integers, float[] scales) -> (Tensor position, Tensor orientation, "
      "Tensor velocity, Tensor angular_velocity, Tensor target, Tensor stay_until)");
  library.def(
      "simulate_plan(Tensor[] state, Tensor step, int[] integers, float[] scales) -> (Tensor velocity, "
      "Tensor angular_velocity, Tensor target, Tensor stay_until)");
  library.def(
      "simulate_respond(Tensor[] state, Tensor fraction) -> (Tensor position, Tensor orientation, Tensor velocity, "
      "Tensor angular_velocity)");
  // planned: velocity, angular_velocity, target, stay_until
  library.def("simulate_commit(Tensor(a!)[] state, Tensor[] planned, Tensor fraction, Tensor discard) -> ()");
  library.def(
      "simulate_slow_all_down(Tensor(a!) first, Tensor(b!) fraction, Tensor(c!) changed, Tensor(d!) changes, "
      "float approach, float smallest) -> ()");
  library.def("simulate_first_toi(Tensor(a!) first, Tensor? robots, Tensor pairs, Tensor toi) -> ()");
  // counts: see kernels/padded_pairs.h
  library.def(
      "simulate_affected_motion(Tensor[] own, Tensor[] ghosts, Tensor fraction, Tensor changed, Tensor pairs, Tensor "
      "mesh_radius, int capacity) -> (Tensor affected, Tensor mesh_index, Tensor position_t0, Tensor position_t1, "
      "Tensor "
      "radius, Tensor orientation, Tensor rotation, Tensor counts)");
  // Number of robots, hash of contacts, hash of states, number of robots that stopped, number of contacts at the start,
  // hash of ids.
  library.def("simulate_tally(Tensor[] state, Tensor fraction, Tensor id, Tensor pairs, Tensor toi) -> Tensor");
  library.def("simulate_hash(Tensor[] columns) -> Tensor");
  library.def("random_uniforms(Tensor id, int seed, int step, int stream) -> Tensor");
}
