// The operators. pgccd/ops/ documents them: shapes, units, errors.
//
// mesh_set = [vertices (V, 3) f64, faces (F, 3) i32, edges (E, 2) i32, triangles (F, 8) i32, node_blocks (n, 9, 8) f32,
//             node_links (n, 8, 4) i32, leaf_points (p, 4, 8) as i32, corners (9, C) f32, of F without points,
//             offsets (meshes + 1, 6) i64, centres (meshes, 3), reaches (meshes,), both empty if all SBV centres
//             are origins, node_supports (n, 8, 24) i32] see core/mesh_set.h
// rigid bodies = [mesh_index (N,) i32, position_t0 (N, 3), position_t1 (N, 3), radius (N,), orientation (N, 4),
//                 rotation (N, 3)]
// deforming bodies = [mesh_index (N,) i32, position_t0, position_t1, radius, vertices_t0 (X, 3), vertices_t1 (X, 3),
//                     blocks_t0 (Y, 9, 8) f32, blocks_t1 (Y, 9, 8) f32, vertex_begin (N,) i64, block_begin (N,) i64,
//                     local_vertices (X, 2, 4) f32] see core/bodies.h; either list may be followed by margin (N,)
// swept = [position_t0 (N, 3), position_t1 (N, 3), radius (N,), group (N,) i64, mask (N,) i64, world (N,) i32,
//          is_static (N,) u8, in_other_search (N,) u8, boxes (N, 28) f32 of moving_boxes] see
//          kernels/broad/body_volumes.h; those after the radius may be None, or left out at the end
// All arguments are checked: shapes, dtypes, devices, lengths, and rows that name other rows. On a CPU a wrong one
// raises an error that names it. On a GPU the host does not wait for checks of values: traversals count no pairs and
// overflow (`contacts_padded_*`), or raise (`traverse_*`, `narrow_*`, which wait anyway); other launches fail, as
// torch's own do for an index out of range. The contents of mesh sets and of node blocks are not checked: the package
// makes them.
//
// contact rows = (pair i32, kind i8, features (., 2) i32, status i8, toi f64, coordinates (., 2), point (., 3), normal
// (., 3))
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(pgccd, library) {
  // Checks of columns (., width): 0 magnitude of each number, 1 |length - 1| within the limit, 2 length, 3 each number
  // from 0 to the limit, 4 each number 0 or from 1e-30 to the limit.
  library.def("first_invalid_rows(Tensor[] columns, int[] checks, float[] limits) -> Tensor");
  // radius (N,) of rigid bodies: `given`, or of_meshes (M,) by mesh_index (N,) i32; -inf where a row is invalid.
  // invalid_rows as of first_invalid_rows: position_t0, position_t1, orientation, rotation, mesh_index unless radii are
  // given, margin if there is one.
  library.def(
      "sound_radii(Tensor of_meshes, Tensor mesh_index, Tensor? given, Tensor position_t0, Tensor position_t1, "
      "Tensor orientation, Tensor rotation, Tensor? margin) -> (Tensor radius, Tensor invalid_rows)");
  // A mesh, once: vertices (V, 3) f64, faces (F, 3) i32. On CPUs only. Outputs: those of a mesh set.
  library.def(
      "prepare_mesh(Tensor vertices, Tensor faces, int leaf_size) -> (Tensor edges, Tensor triangles, "
      "Tensor node_blocks, Tensor node_links, Tensor leaf_points, Tensor node_supports)");
  // Robots. arm = [joints (F, 3) i32, places (F, 13) f64, crossing (F, F) f64, chain_begin (N + 1,) i32, chain i32,
  // body_reach (N,) f64]; bodies = [mesh_index i32, radius f64, margin f64, of N bodies and M obstacles; pairs (P, 3)
  // i32]; obstacles = [position_t0 (R, M, 3), position_t1, orientation (R, M, 4), rotation, error (M,)], f64: see
  // kernels/arms/arm.h.
  library.def("arm_poses(Tensor[] arm, Tensor q) -> (Tensor position, Tensor orientation)");
  library.def(
      "arm_arcs(Tensor[] arm, Tensor control, float error, Tensor begin, Tensor end) -> (Tensor position_t0, "
      "Tensor position_t1, Tensor orientation, Tensor rotation, Tensor stray)");
  library.def(
      "certify_paths(Tensor[] mesh_set, Tensor[] arm, Tensor[] bodies, Tensor[] obstacles, bool obstacles_move, "
      "float room, Tensor control, int degree, float error, float resolution) -> (Tensor verdict, Tensor segment, "
      "Tensor toi, "
      "Tensor bodies, Tensor point, Tensor counts)");
  library.def("rotations_between(Tensor orientation_t0, Tensor orientation_t1) -> Tensor");
  library.def(
      "refit(Tensor[] mesh_set, Tensor mesh_index, Tensor vertices_t0, Tensor vertices_t1, Tensor vertex_begin, "
      "Tensor block_begin, int block_count) -> (Tensor position_t0, Tensor position_t1, Tensor radius, "
      "Tensor blocks_t0, Tensor blocks_t1, Tensor local_vertices)");
  library.def(
      "poses_at(Tensor position_t0, Tensor position_t1, Tensor orientation, Tensor rotation, Tensor time) -> "
      "(Tensor position, Tensor orientation_at)");
  library.def(
      "shorten_arcs(Tensor position_t0, Tensor position_t1, Tensor rotation, Tensor fraction) -> (Tensor end, "
      "Tensor turn)");
  library.def(
      "moving_spheres(Tensor[] mesh_set, Tensor[] bodies, bool linear_path) -> (Tensor centre_t0, Tensor centre_t1, "
      "Tensor reach)");
  // (bodies, 28) f32: see core/moving_box.h
  library.def("moving_boxes_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path) -> Tensor");
  library.def("moving_boxes_deforming(Tensor[] mesh_set, Tensor[] bodies) -> Tensor");
  // broad_phase: see kernels/broad/broad.h; axis: used by the sweep only
  library.def(
      "broad_pairs(Tensor?[] swept, float min_separation, float tolerance, int broad_phase, int axis, "
      "bool at_any_times=False) -> Tensor");
  // pairs (P, 2) i64 of broad_pairs at any times, rows of -1 anywhere; meeting (P, 2) i64, padded with -1; found (1,)
  // i64. Of `swept`, filters are not read.
  library.def(
      "meeting_pairs(Tensor pairs, Tensor?[] swept, float min_separation, float tolerance) -> (Tensor meeting, "
      "Tensor found)");
  library.def(
      "traverse_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor? horizon, "
      "float min_separation, float tolerance, bool tests_start) -> (Tensor candidates, Tensor node_tests)");
  library.def(
      "traverse_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor? horizon, float min_separation, "
      "float tolerance, bool tests_start) -> (Tensor candidates, Tensor node_tests)");
  library.def(
      "narrow_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor candidates, "
      "float min_separation, float tolerance, bool nonzero_toi, int report) -> (Tensor, Tensor, Tensor, Tensor, "
      "Tensor, Tensor, Tensor, Tensor)");
  library.def(
      "narrow_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor candidates, float min_separation, "
      "float tolerance, bool nonzero_toi, int report) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, "
      "Tensor)");
  // Does not synchronise. capacity = [pairs, overlaps, long_rows], see kernels/padded_pairs.h.
  library.def(
      "pairs_padded(Tensor?[] swept, Tensor? is_invalid, float min_separation, float tolerance, int broad_phase, "
      "int[] capacity, bool at_any_times=False) -> (Tensor pairs, Tensor counts)");
  // Columns of contacts, body pairs (., 2) i64 first; all counts, followed by invalid_rows. options: QueryOptions of
  // bind/padded_ops.h. capacity = [poses, tasks, leaf_pairs, candidates, launches, crowded, open, contacts]; capacities
  // and counts: see kernels/traverse/traverse.h and kernels/narrow/narrow.h.
  library.def(
      "contacts_padded_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, Tensor pair_counts, "
      "Tensor invalid_rows, float min_separation, float tolerance, int[] options, int[] capacity) -> "
      "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor counts)");
  library.def(
      "contacts_padded_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, Tensor pair_counts, "
      "Tensor invalid_rows, float min_separation, float tolerance, int[] options, int[] capacity) -> (Tensor, Tensor, "
      "Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor counts)");
  // A whole step: pairs_padded, then contacts_padded_rigid. If invalid_rows, as of sound_radii, says that a row is
  // invalid, no pairs are found; but with searches_sound those of all bodies whose sphere has a radius >= 0. If
  // capacity.contacts is -1, all pairs found are returned, or none if there are more than pair_capacity.pairs.
  library.def(
      "detect_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor?[] swept, Tensor invalid_rows, "
      "bool searches_sound, float min_separation, float tolerance, int[] options, int broad_phase, "
      "int[] pair_capacity, int[] capacity) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, "
      "Tensor counts)");
  // Lowers first (N,) f64 at the owners (P, 2) i64 of each pair; capacity without contacts, counts without
  // invalid_rows.
  library.def(
      "lower_first_toi_rigid(Tensor(a!) first, Tensor owners, Tensor[] mesh_set, Tensor[] bodies, bool linear_path, "
      "Tensor pairs, Tensor pair_counts, float min_separation, float tolerance, bool nonzero_toi, int[] capacity) -> "
      "Tensor counts");
  library.def(
      "vertex_face(Tensor points_t0, Tensor points_t1, float min_separation, float tolerance, bool nonzero_toi) -> "
      "(Tensor status, Tensor toi, Tensor coordinates, Tensor significant_bits)");
  library.def(
      "edge_edge(Tensor points_t0, Tensor points_t1, float min_separation, float tolerance, bool nonzero_toi) -> "
      "(Tensor status, Tensor toi, Tensor coordinates, Tensor significant_bits)");

  // pairs (P, 2) i64; bounds of their distances (P,), the time (P,) and the points (P, 2, 3) of the upper one
  library.def(
      "distances_rigid(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor pairs, float cutoff, "
      "float tolerance) -> (Tensor lower, Tensor upper, Tensor time, Tensor points)");
  library.def(
      "distances_deforming(Tensor[] mesh_set, Tensor[] bodies, Tensor pairs, float cutoff, float tolerance) -> "
      "(Tensor lower, Tensor upper, Tensor time, Tensor points)");

  // Rows of columns: tensors of any type and width with equal numbers of rows.
  // packed (rows, bytes) u8: a row's bytes in all columns, in order; rows, removed (rows,) i64
  library.def("pack_rows(Tensor[] columns, Tensor rows) -> Tensor");
  library.def("unpack_rows(Tensor packed, Tensor[] like) -> Tensor[]");
  library.def("take_rows(Tensor[] columns, Tensor[] more, Tensor rows) -> Tensor[]");
  library.def("merge_rows(Tensor[] columns, Tensor removed, Tensor packed) -> Tensor[]");
  library.def("commit_rows(Tensor(a!)[] columns, Tensor[] values, Tensor id, Tensor discard) -> ()");

  // Distribution of bodies over ranks.
  // centres, ghosts = [position_t0 (N, 3), position_t1 (N, 3), radius (N,)]
  // frame = lower corner, cells per length unit, number of cells; each along x, y, z
  // owner (cells,) i64, or (planes, 4) f64
  library.def("swept_boxes(Tensor[] centres, float min_separation, float tolerance) -> (Tensor lower, Tensor upper)");
  library.def(
      "boundary_bodies(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, "
      "int rank) -> (Tensor reach, Tensor boundary, Tensor found)");
  library.def(
      "replica_ranks(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, int rank, "
      "Tensor bodies, int[] received, int ranks) -> (Tensor replica_ranks, Tensor counts)");
  library.def(
      "reached_ranks(Tensor[] centres, float min_separation, float tolerance, float[] frame, Tensor owner, int rank, "
      "Tensor bodies, Tensor? begin, int places, int ranks) -> Tensor");
  library.def("rows_by_rank(Tensor replica_ranks, Tensor rows, Tensor counts, int[] capacities) -> Tensor");
  library.def("counts_to_send(Tensor counts, int[] capacities, Tensor found, int capacity) -> Tensor");
  library.def(
      "owned_pairs(Tensor pairs, Tensor rows, Tensor id, Tensor[] centres, float min_separation, float tolerance, "
      "Tensor reach, float[] frame, Tensor owner, int rank) -> (Tensor owned, Tensor found)");
  library.def(
      "near_ghosts(Tensor[] centres, Tensor reach, Tensor[] ghosts, float min_separation, float tolerance, "
      "float[] frame, Tensor owner, int rank) -> (Tensor near, Tensor found)");
  library.def(
      "leaving_bodies(Tensor position, float[] frame, Tensor owner, int rank, int ranks) -> (Tensor leaving, "
      "Tensor by_destination, Tensor counts)");
  library.def("leaving_and_invalid(Tensor position, Tensor? id, float[] frame, Tensor owner, int rank) -> Tensor");

  // What follows from contacts = [bodies (K, 2) i64, kind i8, features (K, 2) i32, coordinates (K, 2), toi, point (K,
  // 3), normal (K, 3)] of bodies = [mesh_index i32, position_t0, position_t1, orientation, rotation], or [mesh_index,
  // x_t0, x_t1, vertex_begin i64]. incidence, most: see pgccd/geometry/incidence.py.
  library.def(
      "closing_rates(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor[] incidence, int most, "
      "Tensor[] contacts) -> (Tensor rate, Tensor is_reversed, Tensor away, Tensor size)");
  library.def(
      "surface_normals(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor[] incidence, int most, "
      "Tensor[] contacts) -> Tensor");
  library.def(
      "certainly_recede(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, Tensor[] incidence, int most, "
      "Tensor[] contacts, Tensor status, Tensor slack) -> Tensor");

  // Rounds in which collisions are resolved.
  library.def(
      "resolve_slow_down(Tensor(a!) first, Tensor(b!) fraction, Tensor(c!) changed, Tensor(d!) changes, "
      "float approach, float smallest) -> ()");
  library.def("resolve_first_toi(Tensor(a!) first, Tensor pairs, Tensor toi) -> ()");
  // own, ghosts, motion: bodies = [mesh_index, position_t0, position_t1, radius, orientation, rotation, margin if any]
  // counts: see kernels/padded_pairs.h
  library.def(
      "resolve_pairs(Tensor[] own, Tensor[] ghosts, Tensor fraction, Tensor changed, Tensor pairs, bool skips_equal, "
      "bool by_velocity, int capacity) -> (Tensor found, Tensor[] motion, Tensor counts)");

  // The nanorobot simulation.
  // state = [id (N,) i64, position (N, 3), orientation (N, 4), velocity (N, 3), angular_velocity (N, 3),
  //          target (N,) i64, stay_until (N,) i64], see kernels/simulate/robot.h
  // integers, scales: WorldIntegers and WorldScales of kernels/simulate/world.h
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
  // Number of robots, hash of contacts, hash of states, number of robots that stopped, number of contacts at the start,
  // hash of ids.
  library.def("simulate_tally(Tensor[] state, Tensor fraction, Tensor id, Tensor pairs, Tensor toi) -> Tensor");
  library.def("simulate_hash(Tensor[] columns) -> Tensor");
  library.def("random_uniforms(Tensor id, int seed, int step, int stream) -> Tensor");

  // The voxel-based baseline. On CPUs only.
  library.def(
      "voxels_touched(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, float voxel_size, float min_separation, "
      "float tolerance) -> (Tensor voxels, Tensor counts)");
  library.def(
      "voxel_boxes(Tensor[] mesh_set, Tensor[] bodies, bool linear_path, float voxel_size, float min_separation, "
      "float tolerance, Tensor voxels, Tensor counts) -> Tensor");
  library.def(
      "voxel_pairs(Tensor boxes, Tensor segments, Tensor voxels, Tensor first_segment, float voxel_size) -> Tensor");

  // Messages between GPUs of one host, see kernels/peers/peers.h. On GPUs only.
  // memory (ranks * region bytes,) u8, of this rank; addresses (ranks,) i64 of the memory of each rank; stop: address
  // of an i64 in host memory
  library.def("peer_gather(Tensor values, Tensor(a!) memory, Tensor addresses, int stop, int rank) -> Tensor");
  library.def(
      "peer_minimum(Tensor(a!) values, Tensor sent_rows, int[] sent, Tensor received_rows, int[] received, "
      "Tensor? found, Tensor(c!)? anywhere, Tensor(b!) memory, Tensor addresses, int stop, int rank) -> ()");

  // Conditional parts of CUDA graphs, see kernels/graphs/conditional.h. On GPUs only. body: a stream's address
  library.def("has_conditional_nodes(Tensor value) -> bool");
  library.def("begin_conditional(Tensor value, int body) -> ()");
  library.def("end_conditional(Tensor value, int body) -> ()");
}
