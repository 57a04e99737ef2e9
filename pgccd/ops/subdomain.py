"""Whose cells bodies reach: by which ranks share bodies out."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops import library

#: A frame of cells (lower corner, cells a length unit, number of cells; along x, y, z each), the owner (cells,) int64
#: of each, and a rank. Or the frame of a rank's part, planes (P - 1, 4) float64 as of `Bisection`, and the rank.
Subdomain = tuple[list[float], Tensor, int]
Centres = Sequence[Tensor]


def boundary_bodies(
    centres: Centres, min_separation: float, tolerance: float, subdomain: Subdomain
) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies that reach cells of others: reach (N,) uint8, 1 for them; their rows, ascending, in the first `found` (1,)
    places of (N,), then rows of -1. centres: at t0 and t1 (N, 3), and radius (N,)."""
    return library.operators.boundary_bodies(list(centres), min_separation, tolerance, *subdomain)


def replica_ranks(
    centres: Centres,
    min_separation: float,
    tolerance: float,
    subdomain: Subdomain,
    bodies: Tensor,
    ranks: int,
    received: Sequence[int] = (),
) -> tuple[Tensor, Tensor]:
    """(B, ranks) uint8: 1 for other ranks of which one of the rows `bodies` (B,) reaches a cell (a row of -1 none); and
    for the rank that it came from, if these are ghosts, of which so many were `received` from each. And how many bodies
    of each, (ranks,) int64."""
    arguments = (list(centres), min_separation, tolerance, *subdomain, bodies, list(received), ranks)
    return library.operators.replica_ranks(*arguments)


def reached_ranks(
    centres: Centres, min_separation: float, tolerance: float, subdomain: Subdomain, bodies: Tensor, ranks: int
) -> tuple[Tensor, Tensor]:
    """Of the rows `bodies` (B,), the other ranks whose parts they reach: (E,) int64 numbers from 0 to B - 1, and (E,)
    int64 ranks; ascending by rank, then by number. Waits for how many there are."""
    where = list(centres), min_separation, tolerance, *subdomain, bodies
    count = library.operators.reached_ranks(*where, None, 0, ranks)
    begin, total = count.cumsum(0) - count, int(count.sum())
    found = library.operators.reached_ranks(*where, begin, total, ranks)
    number = torch.arange(len(bodies), device=bodies.device).repeat_interleave(count)
    every = max(1, len(bodies))
    # Cells of one rank may have been reached one by one.
    entries = torch.unique(found * every + number)
    return entries % every, torch.div(entries, every, rounding_mode="floor")


def rows_by_rank(replica_ranks: Tensor, rows: Tensor, counts: Tensor, capacities: Sequence[int]) -> Tensor:
    """The rows (B,) that rank 0 holds, then those of rank 1, ..., each padded with -1 to the capacity of the rank; rows
    beyond it are dropped. replica_ranks (B, ranks) and counts as of `replica_ranks`."""
    return library.operators.rows_by_rank(replica_ranks, rows, counts, list(capacities))


def counts_to_send(counts: Tensor, capacities: Sequence[int], found: Tensor, capacity: int) -> Tensor:
    """(ranks, 2) int64, the message to each rank: its number of rows, counts (ranks,); and 1 if the rows of any rank
    exceed its one of `capacities`, or all of them, `found` (1,), exceed `capacity`; else 0."""
    return library.operators.counts_to_send(counts, list(capacities), found, capacity)


def owned_pairs(
    pairs: Tensor,
    rows: Tensor | None,
    id: Tensor,
    centres: Centres,
    min_separation: float,
    tolerance: float,
    reach: Tensor,
    subdomain: Subdomain,
) -> tuple[Tensor, Tensor]:
    """Of the pairs (P, 2) of bodies B, perhaps rows of -1 among them, those whose reference point lies in a cell of the
    rank, that of the smaller id first, in the first `found` (1,) places of (P, 2), then rows of -1. Of the bodies that
    the rank holds, own ones come first, then ghosts: reach (N,) of own ones is as above, id (N + G,) is of all. rows
    (B,): which of them each of the bodies is, and only pairs with a ghost count; None: they are the own ones."""
    return library.operators.owned_pairs(pairs, rows, id, list(centres), min_separation, tolerance, reach, *subdomain)


def near_ghosts(
    centres: Centres, ghosts: Centres, min_separation: float, tolerance: float, subdomain: Subdomain
) -> tuple[Tensor, Tensor]:
    """Rows of bodies that overlap the box around all ghosts in a cell of the rank which they reach; found as above."""
    return library.operators.near_ghosts(list(centres), list(ghosts), min_separation, tolerance, *subdomain)


def leaving_bodies(
    position: Tensor, id: Tensor | None, subdomain: Subdomain, ranks: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of bodies whose centre (N, 3) is in a cell of another rank, in the first places of (N,): ascending; and by
    rank, then ascending; and how many are in the cells of each, (ranks,). id (N,): negative in rows of padding; None:
    there are none."""
    return library.operators.leaving_bodies(position, id, *subdomain, ranks)
