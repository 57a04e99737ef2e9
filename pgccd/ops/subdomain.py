"""The ranks whose parts of space bodies reach."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops import library

#: The frame of the cells (lower corner, cells per length unit, number of cells; each along x, y, z), the owner (cells,)
#: int64 of each, and a rank. Or the frame of a rank's part, planes (P - 1, 4) float64 as of `Bisection`, and the rank.
Subdomain = tuple[list[float], Tensor, int]
Centres = Sequence[Tensor]


def boundary_bodies(
    centres: Centres, min_separation: float, tolerance: float, subdomain: Subdomain
) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies that reach cells of other ranks: reach (N,) uint8, 1 for these bodies; and (N,) their rows, ascending,
    then -1, with their number `found` (1,). centres: at t0 and t1 (N, 3), and radius (N,).
    """
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
    """(B, ranks) uint8: 1 for each other rank that the row `bodies` (B,) reaches (a row of -1 reaches none). For
    ghosts, `received` is the number received from each rank, and the rank that sent a ghost is set too. Second, the
    number of bodies per rank, (ranks,) int64.
    """
    arguments = (list(centres), min_separation, tolerance, *subdomain, bodies, list(received), ranks)
    return library.operators.replica_ranks(*arguments)


def reached_ranks(
    centres: Centres, min_separation: float, tolerance: float, subdomain: Subdomain, bodies: Tensor, ranks: int
) -> tuple[Tensor, Tensor]:
    """The other ranks whose parts the rows `bodies` (B,) reach: (E,) int64 indices into `bodies` and (E,) int64 ranks,
    ascending by rank, then by index. Synchronises.
    """
    where = list(centres), min_separation, tolerance, *subdomain, bodies
    count = library.operators.reached_ranks(*where, None, 0, ranks)
    begin, total = count.cumsum(0) - count, int(count.sum())
    found = library.operators.reached_ranks(*where, begin, total, ranks)
    number = torch.arange(len(bodies), device=bodies.device).repeat_interleave(count)
    every = max(1, len(bodies))
    # A body may reach several cells of one rank, one entry each.
    entries = torch.unique(found * every + number)
    return entries % every, torch.div(entries, every, rounding_mode="floor")


def rows_by_rank(replica_ranks: Tensor, rows: Tensor, counts: Tensor, capacities: Sequence[int]) -> Tensor:
    """The rows (B,) that rank 0 holds, then those of rank 1, ..., each padded with -1 to the capacity of the rank; rows
    beyond the capacity are dropped. replica_ranks (B, ranks) and counts as of `replica_ranks`.
    """
    return library.operators.rows_by_rank(replica_ranks, rows, counts, list(capacities))


def counts_to_send(counts: Tensor, capacities: Sequence[int], found: Tensor, capacity: int) -> Tensor:
    """(ranks, 2) int64, the message to each rank: its number of rows, counts (ranks,); and 1 if the rows for any rank
    exceed its entry of `capacities`, or their total `found` (1,) exceeds `capacity`; else 0.
    """
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
    """Selects from the pairs (P, 2) of bodies B, which may contain rows of -1, those whose reference point is in a cell
    of the rank, the body with the smaller id first: (P, 2), padded with -1 after the first `found` (1,) rows. Held
    bodies are numbered with own ones first, then ghosts: reach (N,) of own bodies is as above, id (N + G,) is of all.
    rows (B,): the held body of each of the bodies, where only pairs with a ghost are selected; None: the bodies are the
    own ones.
    """
    return library.operators.owned_pairs(pairs, rows, id, list(centres), min_separation, tolerance, reach, *subdomain)


def near_ghosts(
    centres: Centres, ghosts: Centres, min_separation: float, tolerance: float, subdomain: Subdomain
) -> tuple[Tensor, Tensor]:
    """Rows of bodies that overlap the box around all ghosts in a cell of the rank that they reach, padded with -1; and
    their number `found` (1,).
    """
    return library.operators.near_ghosts(list(centres), list(ghosts), min_separation, tolerance, *subdomain)


def leaving_bodies(
    position: Tensor, id: Tensor | None, subdomain: Subdomain, ranks: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of bodies whose position (N, 3) is in a cell of another rank, padded to (N,): ascending; and by rank, then
    ascending; and their number per rank, (ranks,). id (N,): negative for padding; None: there is no padding.
    """
    return library.operators.leaving_bodies(position, id, *subdomain, ranks)
