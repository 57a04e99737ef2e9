"""Distribution of bodies over ranks: their boxes, and the ranks whose parts of space they reach."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.ops.library import int64, operator

#: The frame of the cells (lower corner, cells per length unit, number of cells; each along x, y, z), the owner (cells,)
#: int64 of each, and a rank. Or the frame of a rank's part, planes (P - 1, 4) float64 as of `Bisection`, and the rank.
#: The operators take them as three arguments.
Subdomain = tuple[list[float], Tensor, int]
Frame = Sequence[float]
Centres = Sequence[Tensor]


@operator
def swept_boxes(centres: Centres, min_separation: float, tolerance: float) -> tuple[Tensor, Tensor]:
    """Lower and upper corners (N, 3) of the boxes of swept spheres, grown by half of separation and tolerance. The
    boxes of every pair found by `broad_pairs` overlap.
    """
    return torch.empty_like(centres[0]), torch.empty_like(centres[0])


@operator
def boundary_bodies(
    centres: Centres, min_separation: float, tolerance: float, frame: Frame, owner: Tensor, rank: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies that reach cells of other ranks: reach (N,) uint8, 1 for these bodies; and (N,) their rows, ascending,
    then -1, with their number `found` (1,). centres: at t0 and t1 (N, 3), and radius (N,).
    """
    count = centres[2].shape[0]
    return centres[2].new_empty((count,), dtype=torch.uint8), *_rows(centres[2], count)


@operator
def replica_ranks(
    centres: Centres,
    min_separation: float,
    tolerance: float,
    frame: Frame,
    owner: Tensor,
    rank: int,
    bodies: Tensor,
    received: Sequence[int],
    ranks: int,
) -> tuple[Tensor, Tensor]:
    """(B, ranks) uint8: 1 for each other rank that the row `bodies` (B,) reaches (a row of -1 reaches none). For
    ghosts, `received` is the number received from each rank, and the rank that sent a ghost is set too. Second, the
    number of bodies per rank, (ranks,) int64.
    """
    return bodies.new_empty((bodies.shape[0], ranks), dtype=torch.uint8), int64(bodies, ranks)


def reached_ranks(
    centres: Centres, min_separation: float, tolerance: float, subdomain: Subdomain, bodies: Tensor, ranks: int
) -> tuple[Tensor, Tensor]:
    """The other ranks whose parts the rows `bodies` (B,) reach: (E,) int64 indices into `bodies` and (E,) int64 ranks,
    ascending by rank, then by index. Synchronises.
    """
    where = centres, min_separation, tolerance, *subdomain, bodies
    count = _reached_ranks(*where, None, 0, ranks)
    begin, total = count.cumsum(0) - count, int(count.sum())
    found = _reached_ranks(*where, begin, total, ranks)
    number = torch.arange(len(bodies), device=bodies.device).repeat_interleave(count)
    every = max(1, len(bodies))
    # A body may reach several cells of one rank, one entry each.
    entries = torch.unique(found * every + number)
    return entries % every, torch.div(entries, every, rounding_mode="floor")


@operator
def _reached_ranks(
    centres: Centres,
    min_separation: float,
    tolerance: float,
    frame: Frame,
    owner: Tensor,
    rank: int,
    bodies: Tensor,
    begin: Tensor | None,
    places: int,
    ranks: int,
) -> Tensor:
    """The number of entries of each row (B,); or, given the first entry of each, all `places` entries."""
    return int64(bodies, bodies.shape[0] if begin is None else places)


@operator
def rows_by_rank(replica_ranks: Tensor, rows: Tensor, counts: Tensor, capacities: Sequence[int]) -> Tensor:
    """The rows (B,) that rank 0 holds, then those of rank 1, ..., each padded with -1 to the capacity of the rank; rows
    beyond the capacity are dropped. replica_ranks (B, ranks) and counts as of `replica_ranks`.
    """
    return int64(rows, sum(capacities))


@operator
def counts_to_send(counts: Tensor, capacities: Sequence[int], found: Tensor, capacity: int) -> Tensor:
    """(ranks, 2) int64, the message to each rank: its number of rows, counts (ranks,); and 1 if the rows for any rank
    exceed its entry of `capacities`, or their total `found` (1,) exceeds `capacity`; else 0.
    """
    return int64(counts, len(capacities), 2)


@operator
def owned_pairs(
    pairs: Tensor,
    rows: Tensor,
    id: Tensor,
    centres: Centres,
    min_separation: float,
    tolerance: float,
    reach: Tensor,
    frame: Frame,
    owner: Tensor,
    rank: int,
) -> tuple[Tensor, Tensor]:
    """Selects from the pairs (P, 2) of bodies B, which may contain rows of -1, those whose reference point is in a cell
    of the rank, except pairs of two own bodies of which one reaches no other rank. The body with the smaller id is
    first: (P, 2), padded with -1 after the first `found` (1,) rows. rows (B,): the held body of each of the bodies;
    held bodies are numbered with own ones first, then ghosts. reach (N,) of own bodies is as above, id (N + G,) is of
    all.
    """
    return int64(pairs, pairs.shape[0], 2), int64(pairs, 1)


@operator
def near_ghosts(
    centres: Centres,
    reach: Tensor,
    ghosts: Centres,
    min_separation: float,
    tolerance: float,
    frame: Frame,
    owner: Tensor,
    rank: int,
) -> tuple[Tensor, Tensor]:
    """Rows of bodies that overlap the box around all ghosts in a cell of the rank that they reach, or reach other ranks
    themselves (reach (N,) as above), padded with -1; and their number `found` (1,).
    """
    return _rows(centres[2], centres[2].shape[0])


@operator
def leaving_bodies(
    position: Tensor, frame: Frame, owner: Tensor, rank: int, ranks: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of bodies whose position (N, 3) is in a cell of another rank, padded to (N,): ascending; and by rank, then
    ascending; and their number per rank, (ranks,).
    """
    count = position.shape[0]
    return int64(position, count), int64(position, count), int64(position, ranks)


@operator
def leaving_and_invalid(position: Tensor, id: Tensor | None, frame: Frame, owner: Tensor, rank: int) -> Tensor:
    """(2,) int64: the number of these bodies, and of bodies whose position is invalid. id (N,): negative for padding;
    None: there is no padding.
    """
    return int64(position, 2)


def _rows(like: Tensor, count: int) -> tuple[Tensor, Tensor]:
    return int64(like, count), int64(like, 1)
