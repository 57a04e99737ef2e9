"""The ranks with which a rank exchanges bodies: all of them, or its neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.distributed.comm.interface import Comm, Pending


class Neighbourhood:
    """A rank and its neighbours, numbered from 0 in ascending order. The relation is symmetric.

    All other ranks have one more number, the last one, to which no rows can be sent; so tables and counts have one
    column per neighbour, however many ranks there are.

    Args:
        comm: between all ranks.
        ranks: this rank and its neighbours, ascending. Default: all ranks, which keep their numbers.
    """

    def __init__(self, comm: Comm, ranks: Sequence[int] | None = None) -> None:
        self.comm = comm
        self._ranks = None if ranks is None else list(ranks)

    @property
    def is_all(self) -> bool:
        """Whether all ranks are neighbours."""
        return self._ranks is None

    @property
    def ranks(self) -> Sequence[int]:
        """The neighbours and this rank, ascending."""
        return range(self.comm.size) if self._ranks is None else self._ranks

    @property
    def size(self) -> int:
        """Number of destinations: one per neighbour, and one for all other ranks if there are any."""
        return len(self.ranks) + (not self.is_all)

    @property
    def rank(self) -> int:
        """The number of this rank."""
        return self.ranks.index(self.comm.rank)

    @property
    def others(self) -> list[int]:
        """The numbers of the other neighbours."""
        return [number for number, rank in enumerate(self.ranks) if rank != self.comm.rank]

    def numbers(self) -> Tensor | None:
        """(ranks,) int64: the number of each rank; None if ranks keep their numbers."""
        if self._ranks is None:
            return None
        number = torch.full((self.comm.size,), len(self._ranks))
        number[self._ranks] = torch.arange(len(self._ranks))
        return number

    def counts_of_ranks(self, counts: Sequence[int]) -> list[int]:
        """One count per rank, given one per neighbour; 0 for all other ranks."""
        of_ranks = [0] * self.comm.size
        # The last count, of all other ranks, has no rank.
        for rank, count in zip(self.ranks, counts, strict=False):
            of_ranks[rank] = count
        return of_ranks

    def renumber(self, former: Neighbourhood, values: Tensor) -> Tensor:
        """values (..., former.size), one per neighbour of a former neighbourhood, for the neighbours of this one: (...,
        size). 0 for new neighbours.
        """
        if self.ranks == former.ranks:
            return values
        numbers = {rank: number for number, rank in enumerate(self.ranks)}
        kept = [(number, numbers[rank]) for number, rank in enumerate(former.ranks) if rank in numbers]
        renumbered = values.new_zeros((*values.shape[:-1], self.size))
        renumbered[..., [new for _, new in kept]] = values[..., [old for old, _ in kept]]
        return renumbered

    def exchange(self, rows: Tensor, sent: list[int], received: list[int]) -> Pending[Tensor]:
        """Exchange of rows as `Comm.exchange`, with one count per destination."""
        if self._ranks is None:
            return self.comm.exchange(rows, sent, received)
        return self.comm.exchange(rows, sent[:-1], received[:-1], self._ranks)

    def exchange_counts(self, counts: Tensor) -> Tensor:
        """counts (size,) int64, one per destination -> the count for this rank of each."""
        if self._ranks is None:
            return self.comm.exchange_counts(counts)
        arrived = self.comm.exchange_counts(counts[:-1], self._ranks)
        return torch.cat([arrived, torch.zeros_like(counts[-1:])])

    def agree(self, counts: Tensor) -> tuple[list[int], list[int]]:
        """Numbers of rows sent to and received from each destination, given the former (size,) int64. Synchronises."""
        sent, received = torch.stack([counts, self.exchange_counts(counts)]).tolist()
        return sent, received
