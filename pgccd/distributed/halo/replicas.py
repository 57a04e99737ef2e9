"""The other ranks that hold a body: as a table, or as a list for many ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.halo.centres import Centres

#: Above this number of ranks lists are used: a table has one byte per body and rank.
MOST_TABLE_RANKS = 64


class Replicas(Protocol):
    """The replica ranks of B bodies."""

    @property
    def counts(self) -> Tensor:
        """(ranks,) int64: number of the bodies that each rank holds."""

    def rows_by_rank(self, rows: Tensor, capacities: list[int]) -> Tensor:
        """The rows (B,) of the bodies that rank 0 holds, then those of rank 1, ..., each padded with -1 to the capacity
        of the rank.
        """


@dataclass(frozen=True)
class ReplicaTable:
    """One byte per body and rank. Does not synchronise."""

    table: Tensor  #: (B, ranks) uint8: 1 for each rank that holds the body
    counts: Tensor  #: (ranks,) int64

    def rows_by_rank(self, rows: Tensor, capacities: list[int]) -> Tensor:
        return ops.rows_by_rank(self.table, rows, self.counts, capacities)


@dataclass(frozen=True)
class ReplicaList:
    """Pairs (number of a body, rank that holds it), ascending by rank, then by number."""

    number: Tensor  #: (E,) int64, from 0 to B - 1
    rank: Tensor  #: (E,) int64
    bodies: int  #: B
    counts: Tensor  #: (ranks,) int64

    @classmethod
    def of(cls, number: Tensor, rank: Tensor, bodies: int, ranks: int) -> ReplicaList:
        """From entries in any order."""
        order = torch.argsort(rank * max(1, bodies) + number)
        return cls(number[order], rank[order], bodies, torch.bincount(rank, minlength=ranks))

    def rows_by_rank(self, rows: Tensor, capacities: list[int]) -> Tensor:
        if sum(capacities) == len(self.number):  # lists are exchanged without padding
            return rows[self.number]
        raise ValueError("capacities: a list of replicas is exchanged without padding")

    def after(self, count: int) -> tuple[Tensor, Tensor]:
        """Entries of these bodies as numbered after `count` others."""
        return self.number + count, self.rank


def find_replicas(
    centres: Centres,
    kept: tuple[float, float],
    subdomain: ops.Subdomain,
    rows: Tensor,
    ranks: int,
    received: Sequence[int] = (),
) -> ReplicaTable | ReplicaList:
    """The other ranks whose parts bodies reach; for ghosts also the ranks that sent them.

    Args:
        centres: swept spheres of the bodies.
        kept: min_separation and tolerance, as the operators take them.
        subdomain: of this rank.
        rows: (B,) rows of `centres`; may contain -1 (reaching no rank) up to `MOST_TABLE_RANKS` ranks.
        ranks: their number.
        received: number of these bodies received from each rank, if they are ghosts.
    """
    if ranks <= MOST_TABLE_RANKS:
        where = *kept, *subdomain
        return ReplicaTable(*ops.replica_ranks(centres, *where, rows, received, ranks))
    number, rank = ops.reached_ranks(centres, *kept, subdomain, rows, ranks)
    if received:
        counts, every = torch.tensor(received, device=rows.device), torch.arange(len(rows), device=rows.device)
        source = torch.arange(ranks, device=rows.device).repeat_interleave(counts)
        entries = torch.unique(torch.cat([rank * len(rows) + number, source * len(rows) + every]))
        number, rank = entries % max(1, len(rows)), torch.div(entries, max(1, len(rows)), rounding_mode="floor")
    return ReplicaList(number, rank, len(rows), torch.bincount(rank, minlength=ranks))


def join_replicas(
    ghosts: ReplicaTable | ReplicaList, before: int, own: ReplicaTable | ReplicaList
) -> ReplicaTable | ReplicaList:
    """The replicas of the first ghosts, then own bodies, then the remaining ghosts.

    Args:
        ghosts: replicas of all ghosts.
        before: number of ghosts before the own bodies.
        own: replicas of the own bodies.
    """
    if isinstance(ghosts, ReplicaTable) and isinstance(own, ReplicaTable):
        table = torch.cat([ghosts.table[:before], own.table, ghosts.table[before:]])
        return ReplicaTable(table, ghosts.counts + own.counts)
    assert isinstance(ghosts, ReplicaList) and isinstance(own, ReplicaList)
    later = torch.where(ghosts.number < before, ghosts.number, ghosts.number + own.bodies)
    number, rank = own.after(before)
    entries = torch.cat([later, number]), torch.cat([ghosts.rank, rank])
    return ReplicaList.of(*entries, ghosts.bodies + own.bodies, len(own.counts))
