"""The domain decomposition as one rank sees it: the partition of space, and the rank's neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.partition.interface import Partition


class Decomposition:
    """A partition of space, and the ranks with which this rank exchanges bodies. Made by all ranks together.

    Up to `Comm.neighbours_above` ranks, all ranks are neighbours. Above, the partition defines neighbours by position,
    and `extend` adds further ranks that bodies reach (large or fast bodies, thin parts), for as long as the partition
    lasts. Operators name ranks by their numbers in `neighbours`.

    Args:
        comm: between the ranks.
        partition: the same on all ranks.
        neighbours: of this rank. Default: as above.
    """

    def __init__(self, comm: Comm, partition: Partition, neighbours: Neighbourhood | None = None) -> None:
        self.comm, self.partition = comm, partition
        if neighbours is None:
            is_all = comm.size <= comm.neighbours_above
            neighbours = Neighbourhood(comm, None if is_all else partition.neighbours(comm.rank))
        self._set(neighbours)

    def _set(self, neighbours: Neighbourhood) -> None:
        self.neighbours = neighbours
        #: This rank's part, as the operators expect it.
        self.subdomain: ops.Subdomain = self.partition.subdomain(self.comm.rank, neighbours.numbers())

    def of_all_ranks(self) -> Decomposition:
        """The same partition, with all ranks as neighbours."""
        return Decomposition(self.comm, self.partition, Neighbourhood(self.comm))

    def is_beyond(self, counts: Tensor) -> bool:
        """Whether bodies of any rank reach ranks that are not its neighbours. All ranks call it.

        Args:
            counts: (neighbours.size,) int64: number of bodies for each destination.
        """
        return not self.neighbours.is_all and self.comm.any(bool(counts[-1] > 0))

    def extend(self, ranks: Tensor) -> None:
        """Adds ranks to the neighbours of this rank, and this rank to theirs. All ranks call it.

        Args:
            ranks: (E,) int64.
        """
        marks = torch.zeros(self.comm.size, dtype=torch.int64)
        marks[ranks.cpu()] = 1
        marks += self.comm.exchange_counts(marks)
        self._set(Neighbourhood(self.comm, sorted({*self.neighbours.ranks, *torch.nonzero(marks)[:, 0].tolist()})))

    def copy(self) -> Decomposition:
        """A copy of the tensors, for a CUDA graph that reads them."""
        copied = Decomposition(self.comm, self.partition, self.neighbours)
        frame, owners, number = copied.subdomain
        copied.subdomain = frame, owners.clone(), number
        return copied

    def become(self, other: Decomposition) -> bool:
        """Copies the owners or planes of another decomposition in place. False if its neighbours or its structure
        differ, which a captured graph cannot change.
        """
        mine, theirs = self.subdomain[1], other.subdomain[1]
        if mine.shape != theirs.shape or self.neighbours.ranks != other.neighbours.ranks:
            return False
        mine.copy_(theirs)
        return True
