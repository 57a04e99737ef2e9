"""One-to-one wrappers of the operators `torch.ops.pgccd.*`; their fake kernels are in `pgccd.fake_ops`.

Thin on purpose: shapes and dtypes are checked by the operators, meaning and units are documented by the stage modules
that call these.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

import pgccd._C as _C  # (importing it registers the operators)
import pgccd.fake_ops  # noqa: F401  (and this their fake kernels)
from pgccd.contacts import ContactRows

_ops = torch.ops.pgccd

#: Cells as `Partition.frame` says, owner (cells,) int64 of each, and a rank.
Territory = tuple[list[float], Tensor, int]
Centres = Sequence[Tensor]


def first_faults(columns: Sequence[Tensor], checks: Sequence[int], limits: Sequence[float]) -> Tensor:
    """First faulty row of each column (rows, width), or its number of rows; then 1 if there is any, else 0: (n + 1,).

    Checks: 0, no number's magnitude exceeds the limit; 1, a row's length is 1 within the limit; 2, nor exceeds it.
    """
    return _ops.first_faults(list(columns), list(checks), list(limits))


def rotations_between(orientation_t0: Tensor, orientation_t1: Tensor) -> Tensor:
    """Rotation vectors (N, 3) of the turns between two orientations (N, 4)."""
    return _ops.rotations_between(orientation_t0.contiguous(), orientation_t1.contiguous())


def refit(
    mesh_set: Sequence[Tensor],
    mesh_index: Tensor,
    vertices_t0: Tensor,
    vertices_t1: Tensor,
    vertex_begin: Tensor,
    block_begin: Tensor,
    block_count: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Centres at t0 and t1 (N, 3), radius (N,), and node blocks (Y, 9, 8) at t0 and t1 of deforming bodies."""
    return _ops.refit(list(mesh_set), mesh_index, vertices_t0, vertices_t1, vertex_begin, block_begin, block_count)


def sweep(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    min_separation: float,
    axis: int,
) -> Tensor:
    """Sorted pairs (P, 2) int64 of swept spheres that meet."""
    return _ops.sweep(position_t0, position_t1, radius, group, mask, world, is_static, min_separation, axis)


def grid(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    min_separation: float,
) -> Tensor:
    """As `sweep`, by a hashed grid."""
    return _ops.grid(position_t0, position_t1, radius, group, mask, world, is_static, min_separation)


def lbvh(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    min_separation: float,
) -> Tensor:
    """As `sweep`, by a linear bounding volume hierarchy."""
    return _ops.lbvh(position_t0, position_t1, radius, group, mask, world, is_static, min_separation)


def swept_boxes(
    position_t0: Tensor, position_t1: Tensor, radius: Tensor, min_separation: float
) -> tuple[Tensor, Tensor]:
    """Lower and upper corners (N, 3) of the boxes of swept spheres with half the separation, rounded outward."""
    return _ops.swept_boxes(position_t0, position_t1, radius, min_separation)


def border_bodies(centres: Centres, min_separation: float, territory: Territory) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies that reach cells of others: reach (N,) uint8, 1 for them; their rows, ascending, in the first `found` (1,)
    places of (N,). centres: at t0 and t1 (N, 3), and radius (N,)."""
    return _ops.border_bodies(list(centres), min_separation, *territory)


def reached_ranks(centres: Centres, min_separation: float, territory: Territory, bodies: Tensor, ranks: int) -> Tensor:
    """(B, ranks) uint8: 1 where a body of the rows `bodies` (B,) reaches a cell of a rank, this one or another."""
    return _ops.reached_ranks(list(centres), min_separation, *territory[:2], bodies, ranks)


def owned_pairs(
    pairs: Tensor, own_count: int, centres: Centres, min_separation: float, reach: Tensor, territory: Territory
) -> tuple[Tensor, Tensor]:
    """Rows of pairs (P, 2) whose reference point lies in a cell of the rank, in the first `found` (1,) places of (P,).
    reach (N,) uint8: bit 0 as above; bit 1 of ghosts, of which every pair after the first `own_count` must have one."""
    return _ops.owned_pairs(pairs, own_count, list(centres), min_separation, reach, *territory)


def near_ghosts(
    centres: Centres, ghosts: Centres, min_separation: float, territory: Territory
) -> tuple[Tensor, Tensor]:
    """Rows of bodies that overlap the box around all ghosts in a cell of the rank which they reach; found as above."""
    return _ops.near_ghosts(list(centres), list(ghosts), min_separation, *territory)


def leaving_bodies(position: Tensor, territory: Territory, ranks: int) -> tuple[Tensor, Tensor]:
    """Rows of bodies whose centre (N, 3) is in a cell of another rank; and how many are in those of each, (ranks,)."""
    return _ops.leaving_bodies(position, *territory, ranks)


def traverse_rigid(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    horizon: Tensor | None,
    min_separation: float,
    tolerance: float,
    leading: bool,
) -> tuple[Tensor, Tensor]:
    """Candidates (C, 4) int32 of rigid body pairs, and the number of node tests (1,)."""
    return _ops.traverse_rigid(
        list(mesh_set), list(bodies), linear_path, pairs, horizon, min_separation, tolerance, leading
    )


def traverse_deforming(mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object) -> tuple[Tensor, Tensor]:
    """As `traverse_rigid`, for deforming bodies, whose paths are linear."""
    return _ops.traverse_deforming(list(mesh_set), list(bodies), *rest)


def narrow_rigid(
    mesh_set: Sequence[Tensor],
    bodies: Sequence[Tensor],
    linear_path: bool,
    pairs: Tensor,
    candidates: Tensor,
    min_separation: float,
    tolerance: float,
    nonzero_toi: bool,
    report: int,
) -> ContactRows:
    """Contact rows of the candidates of rigid body pairs."""
    return _ops.narrow_rigid(
        list(mesh_set), list(bodies), linear_path, pairs, candidates, min_separation, tolerance, nonzero_toi, report
    )


def narrow_deforming(mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object) -> ContactRows:
    """As `narrow_rigid`, for deforming bodies, whose paths are linear."""
    return _ops.narrow_deforming(list(mesh_set), list(bodies), *rest)


def pairs_within(
    position_t0: Tensor,
    position_t1: Tensor,
    radius: Tensor,
    group: Tensor | None,
    mask: Tensor | None,
    world: Tensor | None,
    is_static: Tensor | None,
    is_invalid: Tensor | None,
    min_separation: float,
    broad_phase: int,
    capacity: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Pairs padded with -1, and counts (7,): see `pgccd.capacity`. Waits for nothing on a GPU."""
    columns = position_t0, position_t1, radius, group, mask, world, is_static, is_invalid
    return _ops.pairs_within(*columns, min_separation, broad_phase, list(capacity))


def contacts_within_rigid(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], linear_path: bool, *rest: object
) -> tuple[Tensor, ...]:
    """As `contacts_within_deforming`, for rigid bodies."""
    return _ops.contacts_within_rigid(list(mesh_set), list(bodies), linear_path, *rest)


def contacts_within_deforming(
    mesh_set: Sequence[Tensor], bodies: Sequence[Tensor], *rest: object
) -> tuple[Tensor, ...]:
    """Contact rows padded, with body pairs first; all counts (21,) and then the faults. Waits for nothing on a GPU.

    `rest`: pairs, pair_counts, faults, min_separation, tolerance, nonzero_toi, report, capacity.
    """
    return _ops.contacts_within_deforming(list(mesh_set), list(bodies), *rest)


def take_scratch_peak() -> int:
    """Most bytes of scratch memory that one operator on a GPU has held for this thread since the last call."""
    return _C.take_scratch_peak()


def vertex_face(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Status (n,), toi (n,), coordinates (n, 2), significant bits (n,) of vertex-face queries (n, 4, 3), f32 or f64."""
    return _ops.vertex_face(points_t0, points_t1, min_separation, tolerance, nonzero_toi)


def edge_edge(
    points_t0: Tensor, points_t1: Tensor, min_separation: float, tolerance: float, nonzero_toi: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Status (n,), toi (n,), coordinates (n, 2), significant bits (n,) of edge-edge queries (n, 4, 3), f32 or f64."""
    return _ops.edge_edge(points_t0, points_t1, min_separation, tolerance, nonzero_toi)


def simulate_start(id: Tensor, integers: Sequence[int], scales: Sequence[float]) -> tuple[Tensor, ...]:
    """Position, orientation, velocity, angular velocity, target and stay of the robots `id` (N,) at the start."""
    return _ops.simulate_start(id, list(integers), list(scales))


def simulate_plan(
    state: Sequence[Tensor], step: int, integers: Sequence[int], scales: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Velocity, angular velocity, target and stay of robots for the step to come."""
    _check_counter_words(step=step)
    return _ops.simulate_plan(list(state), step, list(integers), list(scales))


def simulate_respond(state: Sequence[Tensor], fraction: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position, orientation, velocity and angular velocity of robots that made `fraction` (N,) of a step."""
    return _ops.simulate_respond(list(state), fraction)


def simulate_pair_motion(
    own: Sequence[Tensor], ghosts: Sequence[Tensor], fraction: Tensor, pairs: Tensor, mesh_radius: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Mesh, position at t0 and t1, radius, orientation and rotation of the robots of pairs (P, 2), two rows a pair, of
    which each makes `fraction` (N + G,) of its step; pairs may be padded with -1. own, ghosts: the first five columns
    of a state; rows of ghosts follow own ones. mesh_radius (M,): the robot with id k has mesh k modulo M."""
    return _ops.simulate_pair_motion(list(own), list(ghosts), fraction, pairs, mesh_radius)


def simulate_slow_down(
    robots: Tensor, first: Tensor, fraction: Tensor, approach: float, smallest: float
) -> tuple[Tensor, Tensor]:
    """What the rows `robots` (R,) make of a step, given first toi and fraction so far (N,), and who changes (uint8)."""
    return _ops.simulate_slow_down(robots, first, fraction, approach, smallest)


def simulate_slow_all_down(
    first: Tensor, fraction: Tensor, changed: Tensor, approach: float, smallest: float
) -> Tensor:
    """The same for all robots, in place: fraction (N,), and changed (N,) uint8, 1 for those that change; first (N,)
    becomes infinite. Returns (1,) int64: 1 if any changes, else 0."""
    return _ops.simulate_slow_all_down(first, fraction, changed, approach, smallest)


def simulate_first_toi(first: Tensor, robots: Tensor | None, pairs: Tensor, toi: Tensor) -> None:
    """Lowers first (N,), in place, to the toi (K,) of contacts of pairs (K, 2) of robots, which may be padded with -1;
    or of copies of robots: robots (C,) says of which each is one."""
    _ops.simulate_first_toi(first, robots, pairs, toi)


def simulate_concerned_pairs(pairs: Tensor, changed: Tensor, room: int) -> tuple[Tensor, Tensor]:
    """Those of the pairs (P, 2) with a robot of which changed (N,) uint8 is 1: (room, 2), padded with -1; and counts
    (7,) as of `pairs_within`. Waits for nothing on a GPU."""
    return _ops.simulate_concerned_pairs(pairs, changed, room)


def simulate_tally(state: Sequence[Tensor], fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64 of a step: robots, hash of contacts, hash of states, robots that stopped, contacts at its start, hash
    of ids. state: columns after it (N, ...), ids first; fraction (N,) of it that each made; contacts are of pairs
    (K, 2), which may be padded with -1, of robots with these id (H,)."""
    return _ops.simulate_tally([column.contiguous() for column in state], fraction, id, pairs, toi)


def simulate_hash(columns: Sequence[Tensor]) -> Tensor:
    """(1,) int64: the sum modulo 2^64 of the rows' hashes; columns (N,) or (N, k), int64 or float64."""
    return _ops.simulate_hash([column.contiguous() for column in columns])


def random_uniforms(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    """Numbers (N, 4) in (0, 1) of the counters (id, step, stream): Philox4x32-10, key `seed` (any int64)."""
    _check_counter_words(step=step, stream=stream)
    return _ops.random_uniforms(id.contiguous(), seed, step, stream)


def _check_counter_words(**words: int) -> None:
    for name, word in words.items():
        if not 0 <= word < 2**32:
            raise ValueError(f"{name}: expected a value in [0, 2^32), got {word}")
