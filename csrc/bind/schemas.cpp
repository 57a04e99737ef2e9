// The detection operators; those of other stages are in *_schemas.cpp. pgccd/ops/ documents them: shapes, units,
// errors.
//
// mesh_set = [vertices (V, 3) f64, faces (F, 3) i32, edges (E, 2) i32, triangles (F, 8) i32, node_blocks (n, 9, 8) f32,
//             node_links (n, 8, 4) i32, leaf_points (p, 4, 8) as i32, corners (9, F + padding) f32,
//             offsets (meshes + 1, 5) i64, centres (meshes, 3), reaches (meshes,), both empty if all SBV centres
//             are origins] see core/mesh_set.h
// rigid bodies = [mesh_index (N,) i32, position_t0 (N, 3), position_t1 (N, 3), radius (N,), orientation (N, 4),
//                 rotation (N, 3)]
// deforming bodies = [mesh_index (N,) i32, position_t0, position_t1, radius, vertices_t0 (X, 3), vertices_t1 (X, 3),
//                     blocks_t0 (Y, 9, 8) f32, blocks_t1 (Y, 9, 8) f32, vertex_begin (N,) i64, block_begin (N,) i64]
//                     see core/bodies.h; either list may be followed by margin (N,)
// All arguments are checked: shapes, dtypes, devices, lengths, and rows that name other rows. On a CPU a wrong one
// raises an error that names it. On a GPU the host does not wait for checks of values: traversals count no pairs and
// overflow (`contacts_padded_*`), or raise (`traverse_*`, `narrow_*`, which wait anyway); other launches fail, as
// torch's own do for an index out of range. The contents of mesh sets and of node blocks are not checked: the package
// makes them.
//
// contact rows = (pair i32, kind i8, features (., 2) i32, status i8, toi f64, coordinates (., 2), point (., 3), normal
// (., 3))
#include <Python.h>
#include <torch/csrc/stable/library.h>

#include <utility>

#include "bind/device_share.h"
#include "bind/scratch_peak.h"

STABLE_TORCH_LIBRARY(pgccd, library) {
  // Checks of columns (., width): 0 magnitude of each number, 1 |length - 1| within the limit, 2 length, 3 each number
  // from 0 to the limit.
  library.def("first_faults(Tensor[] columns, int[] checks, float[] limits) -> Tensor");
  library.def("rotations_between(Tensor orientation_t0, Tensor orientation_t1) -> Tensor");
  library.def(
      "refit(Tensor[] mesh_set, Tensor mesh_index, Tensor vertices_t0, Tensor vertices_t1, Tensor vertex_begin, "
      "Tensor block_begin, int block_count) -> (Tensor position_t0, Tensor position_t1, Tensor radius, Tensor "
      "spheres_t0, "
      "Tensor blocks_t1)");
  library.def(
      "poses_at(Tensor position_t0, Tensor position_t1, Tensor orientation, Tensor rotation, Tensor time) -> (Tensor "
      "position, Tensor orientation_at)");
  library.def(
      "moving_spheres(Tensor[] mesh_set, Tensor[] bodies, bool linear_path) -> (Tensor centre_t0, Tensor centre_t1, "
      "Tensor reach)");
  // broad_phase: see kernels/broad/broad_phase.h; axis: used by the sweep only
  library.def(
      "broad_pairs(Tensor position_t0, Tensor position_t1, Tensor radius, Tensor? group, Tensor? mask, Tensor? world, "
      "Tensor? is_static, Tensor? elsewhere, float min_separation, float tolerance, int broad_phase, int axis) -> "
      "Tensor");
  library.def(
      "traverse_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor? horizon, "
      "float min_separation, float tolerance, bool tests_start) "
      "-> (Tensor candidates, Tensor node_tests)");
  library.def(
      "traverse_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor? horizon, "
      "float min_separation, float tolerance, bool tests_start) "
      "-> (Tensor candidates, Tensor node_tests)");
  library.def(
      "narrow_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor candidates, "
      "float min_separation, float tolerance, bool nonzero_toi, int report) "
      "-> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  library.def(
      "narrow_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor candidates, "
      "float min_separation, float tolerance, bool nonzero_toi, int report) "
      "-> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  // Does not synchronise. capacity = [pairs, overlaps, long_rows], see kernels/padded_pairs.h.
  library.def(
      "pairs_padded(Tensor position_t0, Tensor position_t1, Tensor radius, Tensor? group, Tensor? mask, Tensor? world, "
      "Tensor? is_static, Tensor? elsewhere, Tensor? is_invalid, float min_separation, float tolerance, "
      "int broad_phase, int[] capacity) -> (Tensor pairs, Tensor counts)");
  // Columns of contacts, body pairs (., 2) i64 first; all counts, followed by the faults. capacity = [poses, tasks,
  // leaf_pairs, candidates, launches, open, contacts]; capacities and counts: see kernels/traverse/traverse.h and
  // kernels/narrow/narrow.h.
  library.def(
      "contacts_padded_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor pair_counts, "
      "Tensor faults, "
      "float min_separation, float tolerance, bool nonzero_toi, bool tests_start, int report, int[] capacity) "
      "-> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor counts)");
  library.def(
      "contacts_padded_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor pair_counts, Tensor faults, "
      "float min_separation, float tolerance, bool nonzero_toi, bool tests_start, int report, int[] capacity) "
      "-> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor counts)");
  // A whole step: pairs_padded of the spheres = [position_t0, position_t1, radius], then contacts_padded_rigid. If
  // `spheres` is empty, the bodies' own spheres are used; the bodies must then be centred, without margins. The poses,
  // bodies[1, 2, 4, 5], and more_columns (N, width) f64 are checked as by first_faults, unless `faults` is given. If a
  // row is invalid, no pairs are found; but with a buffer `reach` (N,) f64 those of all valid bodies: the spheres'
  // radii are written to it, -inf for invalid bodies. If capacity.contacts is -1, all pairs found are returned, or none
  // if there are more than pair_capacity.pairs.
  library.def(
      "detect_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor[] spheres, Tensor? group, Tensor? "
      "mask, "
      "Tensor? world, Tensor? is_static, Tensor? faults, Tensor(a!)? reach, Tensor[] more_columns, "
      "int[] checks, float[] limits, "
      "float min_separation, float tolerance, bool nonzero_toi, bool tests_start, int report, int broad_phase, "
      "int[] pair_capacity, int[] capacity) "
      "-> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor counts)");
  // Lowers first (N,) f64 at the owners (P, 2) i64 of each pair; capacity without contacts, counts without faults.
  library.def(
      "lower_first_toi_rigid(Tensor(a!) first, Tensor owners, Tensor[] mesh_set, Tensor[] bodies, bool linear_path, "
      "Tensor pairs, Tensor pair_counts, float min_separation, float tolerance, bool nonzero_toi, int[] capacity) -> "
      "Tensor counts");
  library.def(
      "vertex_face(Tensor points_t0, Tensor points_t1, float min_separation, float tolerance, bool nonzero_toi) "
      "-> (Tensor status, Tensor toi, Tensor coordinates, Tensor significant_bits)");
  library.def(
      "edge_edge(Tensor points_t0, Tensor points_t1, float min_separation, float tolerance, bool nonzero_toi) "
      "-> (Tensor status, Tensor toi, Tensor coordinates, Tensor significant_bits)");
}

namespace pgccd::bind {

int64_t& scratch_peak() {
  thread_local int64_t bytes = 0;
  return bytes;
}

int& device_share() {
  thread_local int share = 1;
  return share;
}

}  // namespace pgccd::bind

namespace {

PyObject* take_scratch_peak(PyObject*, PyObject*) {
  return PyLong_FromLongLong(std::exchange(pgccd::bind::scratch_peak(), 0));
}

PyObject* set_device_share(PyObject*, PyObject* given) {
  const long share = PyLong_AsLong(given);
  if (share == -1 && PyErr_Occurred() != nullptr) return nullptr;
  if (share < 1 || share > 1024) {
    PyErr_SetString(PyExc_ValueError, "share: expected a number from 1 to 1024");
    return nullptr;
  }
  return PyLong_FromLong(std::exchange(pgccd::bind::device_share(), static_cast<int>(share)));
}

PyMethodDef methods[] = {
    {"set_device_share", set_device_share, METH_O,
     "Lets operators called by this thread take 1 / share of a GPU's blocks. Returns the former share."},
    {"take_scratch_peak", take_scratch_peak, METH_NOARGS,
     "Most bytes of scratch memory that an operator on a GPU, called by this thread, has held since the last call."},
    {nullptr, nullptr, 0, nullptr}};

}  // namespace

// Importing pgccd._C runs the registrations of this binary.
PyMODINIT_FUNC PyInit__C() {
  static PyModuleDef definition = {
      PyModuleDef_HEAD_INIT, "_C", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};
  return PyModule_Create(&definition);
}
