"""Numbers of bodies in the messages of a step, and capacities for the next one.

Without capacities ranks exchange counts through the host before they send ghosts. By then a GPU is busy with own pairs,
and these small messages wait for free multiprocessors. A CUDA graph can only send messages of fixed size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from pgccd.distributed.comm.neighbourhood import Neighbourhood

# A capacity is the last count times _SLACK plus _SOME (for small counts), rounded up to a multiple, so that buffers
# rarely change size.
_SLACK, _SOME, _MULTIPLE = 1.25, 64, 256
# Bodies that have left their rank's cells, and stay until migration, reach far into cells of other ranks.
_NEAR_SLACK = 2


@dataclass(frozen=True)
class HaloSizes:
    """Numbers of bodies of one rank in a step: exact ones, or padded ones as capacities. Two ranks compute the same
    capacities for what they exchange.
    """

    neighbours: Neighbourhood  #: by whose numbers the lists are ordered
    sent: list[int]  #: to each neighbour
    received: list[int]  #: from each neighbour
    boundary: int  #: own bodies that other ranks need
    near: int  #: own bodies near ghosts or at the boundary
    common: list[int] = field(default_factory=list)  #: held both by this rank and by each neighbour; empty if unknown

    def renumbered(self, neighbours: Neighbourhood) -> HaloSizes:
        """The same numbers, in the order of other neighbours; 0 for new ones."""
        counts = [self.sent, self.received, *([self.common] if self.common else [])]
        sent, received, *common = neighbours.renumber(self.neighbours, torch.tensor(counts)).tolist()
        return HaloSizes(neighbours, sent, received, self.boundary, self.near, *common)

    def padded(self, neighbours: Neighbourhood) -> HaloSizes:
        """Capacities for the next step, which has these neighbours, given the numbers of the last one."""
        now = self.renumbered(neighbours)
        sent, received, common = (padded_counts(each, neighbours) for each in (now.sent, now.received, now.common))
        boundary, near = padded_count(self.boundary), padded_count(_NEAR_SLACK * self.near)
        return HaloSizes(neighbours, sent, received, boundary, near, common)


def padded_count(count: int) -> int:
    """The capacity for a count."""
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE


def padded_counts(counts: Sequence[int], neighbours: Neighbourhood) -> list[int]:
    """Capacities for a count per destination; 0 for this rank, and for all that are not neighbours. Other neighbours
    have a capacity even if their count is 0: parts that meet at a corner share a body in some steps, none in others.
    """
    others = neighbours.others
    return [padded_count(count) if number in others else 0 for number, count in enumerate(counts)]
