"""Fake kernels of the operators, for `torch.compile` and `torch.export`: shapes and dtypes, no data."""

from __future__ import annotations

from math import prod
from typing import Any

import torch
from torch import Tensor

from pgccd.detection.contacts import ContactRows


def _unknown_count() -> torch.SymInt:
    return torch.library.get_ctx().new_dynamic_size(min=0)


@torch.library.register_fake("pgccd::first_faults")
def _(columns: list[Tensor], checks: list[int], limits: list[float]) -> Tensor:
    return columns[0].new_empty((len(columns) + 1,), dtype=torch.int64)


@torch.library.register_fake("pgccd::rotations_between")
def _(orientation_t0: Tensor, orientation_t1: Tensor) -> Tensor:
    return orientation_t0.new_empty((orientation_t0.shape[0], 3))


@torch.library.register_fake("pgccd::poses_at")
def _(
    position_t0: Tensor, position_t1: Tensor, orientation: Tensor, rotation: Tensor, time: Tensor
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(position_t0), torch.empty_like(orientation)


@torch.library.register_fake("pgccd::moving_spheres")
def _(mesh_set: list[Tensor], bodies: list[Tensor], linear_path: bool) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(bodies[1]), torch.empty_like(bodies[1]), torch.empty_like(bodies[3])


@torch.library.register_fake("pgccd::refit")
def _(
    mesh_set: list[Tensor],
    mesh_index: Tensor,
    vertices_t0: Tensor,
    vertices_t1: Tensor,
    vertex_begin: Tensor,
    block_begin: Tensor,
    block_count: int,
) -> tuple[Tensor, ...]:
    bodies = mesh_index.shape[0]
    centres = [vertices_t0.new_empty((bodies, 3)) for _ in range(2)]
    blocks = [vertices_t0.new_empty((block_count, 9, 8), dtype=torch.float32) for _ in range(2)]
    return (*centres, vertices_t0.new_empty((bodies,)), *blocks)


def _fake_pairs(position_t0: Tensor, *_rest: object) -> Tensor:
    return position_t0.new_empty((_unknown_count(), 2), dtype=torch.int64)


@torch.library.register_fake("pgccd::swept_boxes")
def _(position_t0: Tensor, *_rest: object) -> tuple[Tensor, Tensor]:
    return torch.empty_like(position_t0), torch.empty_like(position_t0)


@torch.library.register_fake("pgccd::voxels_touched")
def _(mesh_set: list[Tensor], bodies: list[Tensor], *_rest: object) -> tuple[Tensor, Tensor]:
    count = _unknown_count()
    return bodies[0].new_empty((count, 3), dtype=torch.int32), bodies[0].new_empty((count,), dtype=torch.int64)


@torch.library.register_fake("pgccd::voxel_boxes")
def _(mesh_set: list[Tensor], bodies: list[Tensor], *_rest: object) -> Tensor:
    return bodies[0].new_empty((_unknown_count(), 32), dtype=torch.uint8)


@torch.library.register_fake("pgccd::voxel_pairs")
def _(boxes: Tensor, *_rest: object) -> Tensor:
    return boxes.new_empty((_unknown_count(), 4), dtype=torch.int64)


def _fake_rows(count: int | torch.SymInt, like: Tensor) -> tuple[Tensor, Tensor]:
    return like.new_empty((count,), dtype=torch.int64), like.new_empty((1,), dtype=torch.int64)


@torch.library.register_fake("pgccd::boundary_bodies")
def _(centres: list[Tensor], *_rest: object) -> tuple[Tensor, ...]:
    count = centres[2].shape[0]
    return centres[2].new_empty((count,), dtype=torch.uint8), *_fake_rows(count, centres[2])


@torch.library.register_fake("pgccd::replica_ranks")
def _(
    centres: list[Tensor],
    min_separation: float,
    tolerance: float,
    frame: list[float],
    owner: Tensor,
    rank: int,
    bodies: Tensor,
    received: list[int],
    ranks: int,
) -> tuple[Tensor, Tensor]:
    counts = owner.new_empty((ranks,), dtype=torch.int64)
    return owner.new_empty((bodies.shape[0], ranks), dtype=torch.uint8), counts


@torch.library.register_fake("pgccd::reached_ranks")
def _(
    centres: list[Tensor],
    min_separation: float,
    tolerance: float,
    frame: list[float],
    owner: Tensor,
    rank: int,
    bodies: Tensor,
    begin: Tensor | None,
    places: int,
    ranks: int,
) -> Tensor:
    return bodies.new_empty((bodies.shape[0] if begin is None else places,))


@torch.library.register_fake("pgccd::rows_by_rank")
def _(replica_ranks: Tensor, rows: Tensor, counts: Tensor, capacities: list[int]) -> Tensor:
    return rows.new_empty((sum(capacities),))


@torch.library.register_fake("pgccd::counts_to_send")
def _(counts: Tensor, capacities: list[int], found: Tensor, capacity: int) -> Tensor:
    return counts.new_empty((len(capacities), 2))


@torch.library.register_fake("pgccd::owned_pairs")
def _(pairs: Tensor, *_rest: object) -> tuple[Tensor, Tensor]:
    return pairs.new_empty((pairs.shape[0], 2)), pairs.new_empty((1,))


@torch.library.register_fake("pgccd::near_ghosts")
def _(centres: list[Tensor], *_rest: object) -> tuple[Tensor, Tensor]:
    return _fake_rows(centres[2].shape[0], centres[2])


@torch.library.register_fake("pgccd::leaving_bodies")
def _(
    position: Tensor, _id: Tensor | None, _frame: list[float], owner: Tensor, _rank: int, ranks: int
) -> tuple[Tensor, ...]:
    leaving, by_destination = (owner.new_empty((position.shape[0],), dtype=torch.int64) for _ in range(2))
    return leaving, by_destination, owner.new_empty((ranks,), dtype=torch.int64)


def _row_bytes(columns: list[Tensor]) -> int | torch.SymInt:
    return sum(prod(column.shape[1:]) * column.element_size() for column in columns)


def _fake_columns(columns: list[Tensor], count: int | torch.SymInt) -> list[Tensor]:
    return [column.new_empty((count, *column.shape[1:])) for column in columns]


@torch.library.register_fake("pgccd::pack_rows")
def _(columns: list[Tensor], rows: Tensor) -> Tensor:
    return rows.new_empty((rows.shape[0], _row_bytes(columns)), dtype=torch.uint8)


@torch.library.register_fake("pgccd::unpack_rows")
def _(packed: Tensor, like: list[Tensor]) -> list[Tensor]:
    return _fake_columns(like, packed.shape[0])


@torch.library.register_fake("pgccd::take_rows")
def _(columns: list[Tensor], more: list[Tensor], rows: Tensor) -> list[Tensor]:
    return _fake_columns(columns, rows.shape[0])


@torch.library.register_fake("pgccd::merge_rows")
def _(columns: list[Tensor], removed: Tensor, packed: Tensor) -> list[Tensor]:
    return _fake_columns(columns, columns[0].shape[0] - removed.shape[0] + packed.shape[0])


torch.library.register_fake("pgccd::broad_pairs")(_fake_pairs)


def _fake_candidates(pairs: Tensor) -> tuple[Tensor, Tensor]:
    return pairs.new_empty((_unknown_count(), 4), dtype=torch.int32), pairs.new_empty((1,))


@torch.library.register_fake("pgccd::traverse_rigid")
def _(
    mesh_set: list[Tensor], bodies: list[Tensor], linear_path: bool, pairs: Tensor, *_rest: object
) -> tuple[Tensor, Tensor]:
    return _fake_candidates(pairs)


@torch.library.register_fake("pgccd::traverse_deforming")
def _(mesh_set: list[Tensor], bodies: list[Tensor], pairs: Tensor, *_rest: object) -> tuple[Tensor, Tensor]:
    return _fake_candidates(pairs)


@torch.library.register_fake("pgccd::pairs_padded")
def _(position_t0: Tensor, *rest: Any) -> tuple[Tensor, Tensor]:
    capacity = rest[-1]
    return position_t0.new_empty((capacity[0], 2), dtype=torch.int64), position_t0.new_empty((7,), dtype=torch.int64)


def _fake_found(pairs: Tensor, rest: Any) -> tuple[Tensor, ...]:
    (_, faults, *_), count = rest, rest[-1][-1]
    if count < 0:  # as many rows as found
        count = _unknown_count()
    _, *columns = _fake_contact_rows(pairs, count)
    return pairs.new_empty((count, 2)), *columns, pairs.new_empty((21 + faults.shape[0],))


@torch.library.register_fake("pgccd::contacts_padded_rigid")
def _(mesh_set: list[Tensor], bodies: list[Tensor], linear_path: bool, pairs: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return _fake_found(pairs, rest)


@torch.library.register_fake("pgccd::contacts_padded_deforming")
def _(mesh_set: list[Tensor], bodies: list[Tensor], pairs: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return _fake_found(pairs, rest)


@torch.library.register_fake("pgccd::detect_rigid")
def _(mesh_set: list[Tensor], bodies: list[Tensor], *rest: Any) -> tuple[Tensor, ...]:
    pairs, known_faults = bodies[1].new_empty((0, 2), dtype=torch.int64), rest[6]
    return _fake_found(pairs, (None, pairs.new_empty((5,)) if known_faults is None else known_faults, *rest))


@torch.library.register_fake("pgccd::lower_first_toi_rigid")
def _(first: Tensor, owners: Tensor, *_rest: object) -> Tensor:
    return owners.new_empty((21,))


def _fake_contact_rows(pairs: Tensor, count: int | torch.SymInt) -> ContactRows:
    integers = [((), torch.int32), ((), torch.int8), ((2,), torch.int32), ((), torch.int8)]
    lengths = [(width, torch.float64) for width in ((), (2,), (3,), (3,))]
    columns = [pairs.new_empty((count, *width), dtype=dtype) for width, dtype in [*integers, *lengths]]
    return tuple(columns)  # type: ignore[return-value]


@torch.library.register_fake("pgccd::narrow_rigid")
def _(mesh_set: list[Tensor], bodies: list[Tensor], linear_path: bool, pairs: Tensor, *_rest: object) -> ContactRows:
    return _fake_contact_rows(pairs, _unknown_count())


@torch.library.register_fake("pgccd::narrow_deforming")
def _(mesh_set: list[Tensor], bodies: list[Tensor], pairs: Tensor, *_rest: object) -> ContactRows:
    return _fake_contact_rows(pairs, _unknown_count())


def _fake_elementary(points_t0: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    count = points_t0.shape[0]
    status, significant_bits = (points_t0.new_empty((count,), dtype=torch.int8) for _ in range(2))
    return status, points_t0.new_empty((count,)), points_t0.new_empty((count, 2)), significant_bits


@torch.library.register_fake("pgccd::vertex_face")
def _(points_t0: Tensor, *_rest: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _fake_elementary(points_t0)


@torch.library.register_fake("pgccd::edge_edge")
def _(points_t0: Tensor, *_rest: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _fake_elementary(points_t0)


def _fake_robots(like: Tensor, count: int | torch.SymInt, *widths: int) -> tuple[Tensor, ...]:
    return tuple(like.new_empty((count, width), dtype=torch.float64) for width in widths)


@torch.library.register_fake("pgccd::simulate_start")
def _(id: Tensor, integers: list[int], scales: list[float]) -> tuple[Tensor, ...]:
    count = id.shape[0]
    return (*_fake_robots(id, count, 3, 4, 3, 3), id.new_empty((count,)), id.new_empty((count,)))


@torch.library.register_fake("pgccd::simulate_plan")
def _(state: list[Tensor], step: Tensor, integers: list[int], scales: list[float]) -> tuple[Tensor, ...]:
    id = state[0]
    return (*_fake_robots(id, id.shape[0], 3, 3), id.new_empty((id.shape[0],)), id.new_empty((id.shape[0],)))


@torch.library.register_fake("pgccd::simulate_respond")
def _(state: list[Tensor], fraction: Tensor) -> tuple[Tensor, ...]:
    return _fake_robots(fraction, fraction.shape[0], 3, 4, 3, 3)


@torch.library.register_fake("pgccd::simulate_commit")
def _(state: list[Tensor], planned: list[Tensor], fraction: Tensor, discard: Tensor) -> None:
    return None


@torch.library.register_fake("pgccd::simulate_slow_all_down")
def _(first: Tensor, *_rest: object) -> None:
    return None


@torch.library.register_fake("pgccd::simulate_first_toi")
def _(first: Tensor, robots: Tensor | None, pairs: Tensor, toi: Tensor) -> None:
    return None


@torch.library.register_fake("pgccd::simulate_affected_motion")
def _(
    own: list[Tensor],
    ghosts: list[Tensor],
    fraction: Tensor,
    changed: Tensor,
    pairs: Tensor,
    mesh_radius: Tensor,
    capacity: int,
) -> tuple[Tensor, ...]:
    position_t0, position_t1, orientation, rotation = _fake_robots(fraction, 2 * capacity, 3, 3, 4, 3)
    mesh_index, radius = pairs.new_empty((2 * capacity,), dtype=torch.int32), fraction.new_empty((2 * capacity,))
    bodies = mesh_index, position_t0, position_t1, radius, orientation, rotation
    return pairs.new_empty((capacity, 2)), *bodies, pairs.new_empty((7,))


@torch.library.register_fake("pgccd::simulate_tally")
def _(state: list[Tensor], fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    return fraction.new_empty((6,), dtype=torch.int64)


@torch.library.register_fake("pgccd::simulate_hash")
def _(columns: list[Tensor]) -> Tensor:
    return columns[0].new_empty((1,), dtype=torch.int64)


@torch.library.register_fake("pgccd::random_uniforms")
def _(id: Tensor, seed: int, step: int, stream: int) -> Tensor:
    return _fake_robots(id, id.shape[0], 4)[0]
