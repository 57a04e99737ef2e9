"""The neighbours that hold copies of a rank's bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.attempts import TooSmall, until_it_fits


@dataclass(frozen=True)
class Replicas:
    """The neighbours that hold each of B bodies."""

    table: Tensor  #: (B, neighbours.size) uint8: 1 for each that holds the body
    counts: Tensor  #: (neighbours.size,) int64: number of the bodies that each holds

    def rows_by_rank(self, rows: Tensor, capacities: list[int]) -> Tensor:
        """The rows (B,) of the bodies that the first neighbour holds, then those of the second, ..., each padded with
        -1 to the capacity of the neighbour.
        """
        return ops.rows_by_rank(self.table, rows, self.counts, capacities)

    def overflow(self, capacities: list[int], found: Tensor | None = None, capacity: int = 0) -> Tensor:
        """(1,) int64: 1 if a capacity of a neighbour is exceeded, or the capacity of all bodies (by `found` (1,) int64,
        if given), or if a body reaches a rank that is not a neighbour; else 0.
        """
        found = torch.zeros_like(self.counts[:1]) if found is None else found
        return ops.counts_to_send(self.counts, capacities, found, capacity)[0, 1:]

    def renumber(self, former: Neighbourhood, neighbours: Neighbourhood) -> Replicas:
        """These replicas by the numbers of other neighbours, which include the former ones."""
        return Replicas(*(neighbours.renumber(former, values) for values in (self.table, self.counts)))


def find_replicas(
    decomposition: Decomposition,
    centres: ops.Centres,
    distances: tuple[float, float],
    rows: Tensor,
    received: Sequence[int] = (),
) -> Replicas:
    """The other ranks whose parts bodies reach; for ghosts also the ranks that sent them. Does not synchronise.

    Args:
        decomposition: of space.
        centres: swept spheres of the bodies.
        distances: min_separation and tolerance, as the operators take them.
        rows: (B,) rows of `centres`; may contain -1 (reaching no rank).
        received: number of these bodies received from each neighbour, if they are ghosts.
    """
    frame, owner, rank = decomposition.subdomain
    ranks = decomposition.neighbours.size
    return Replicas(*ops.replica_ranks(centres, *distances, frame, owner, rank, rows, received, ranks))


def agreed_replicas(
    decomposition: Decomposition,
    centres: ops.Centres,
    distances: tuple[float, float],
    rows: Tensor,
    received: Sequence[int] = (),
) -> Replicas:
    """The same, after extending the neighbours of ranks if bodies of any rank reach further. All ranks call it.
    Synchronises, unless all ranks are neighbours.
    """
    former = decomposition.neighbours

    def attempt(of_neighbours: Sequence[int]) -> Replicas | TooSmall[Sequence[int]]:
        found = find_replicas(decomposition, centres, distances, rows, of_neighbours)
        if not decomposition.is_beyond(found.counts):
            return found
        beyond = rows[found.table[:, -1] > 0]
        whole = decomposition.of_all_ranks().subdomain
        decomposition.extend(ops.reached_ranks(centres, *distances, whole, beyond, decomposition.comm.size)[1])
        if not received:
            return TooSmall(received)
        return TooSmall(decomposition.neighbours.renumber(former, torch.tensor(received)).tolist())

    return until_it_fits(attempt, received)
