"""Whose cells bodies reach: by which ranks share bodies out."""

from collections.abc import Sequence

from torch import Tensor

from pgccd.ops import library

#: Cells as `Partition.frame` says, owner (cells,) int64 of each, and a rank.
Territory = tuple[list[float], Tensor, int]
Centres = Sequence[Tensor]


def border_bodies(centres: Centres, min_separation: float, territory: Territory) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies that reach cells of others: reach (N,) uint8, 1 for them; their rows, ascending, in the first `found` (1,)
    places of (N,). centres: at t0 and t1 (N, 3), and radius (N,)."""
    return library.operators.border_bodies(list(centres), min_separation, *territory)


def reached_ranks(centres: Centres, min_separation: float, territory: Territory, bodies: Tensor, ranks: int) -> Tensor:
    """(B, ranks) uint8: 1 where a body of the rows `bodies` (B,) reaches a cell of a rank, this one or another."""
    return library.operators.reached_ranks(list(centres), min_separation, *territory[:2], bodies, ranks)


def owned_pairs(
    pairs: Tensor, own_count: int, centres: Centres, min_separation: float, reach: Tensor, territory: Territory
) -> tuple[Tensor, Tensor]:
    """Rows of pairs (P, 2) whose reference point lies in a cell of the rank, in the first `found` (1,) places of (P,).
    reach (N,) uint8: bit 0 as above; bit 1 of ghosts, of which every pair after the first `own_count` must have one."""
    return library.operators.owned_pairs(pairs, own_count, list(centres), min_separation, reach, *territory)


def near_ghosts(
    centres: Centres, ghosts: Centres, min_separation: float, territory: Territory
) -> tuple[Tensor, Tensor]:
    """Rows of bodies that overlap the box around all ghosts in a cell of the rank which they reach; found as above."""
    return library.operators.near_ghosts(list(centres), list(ghosts), min_separation, *territory)


def leaving_bodies(position: Tensor, territory: Territory, ranks: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of bodies whose centre (N, 3) is in a cell of another rank, in the first places of (N,): ascending; and by
    rank, then ascending; and how many are in the cells of each, (ranks,)."""
    return library.operators.leaving_bodies(position, *territory, ranks)
