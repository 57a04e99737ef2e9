"""Ghosts in messages of fixed size, padded relative to the last step.

Otherwise ranks would have to exchange counts through the host before sending ghosts; by then the GPU would be busy with
own pairs, and these small messages would wait for free multiprocessors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.exchange import Columns, Route, pack, unpack
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.halo.centres import Centres
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.replicas import Replicas, find_replicas
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.host_copy import HostCopy

# A capacity is the last count times _SLACK plus _SOME (for small counts), rounded up to a multiple, so that buffers
# rarely change size.
_SLACK, _SOME, _MULTIPLE = 1.25, 64, 256


@dataclass(frozen=True)
class HaloCapacity:
    """Padded counts of bodies in messages. Both ends of a message compute them from the last step."""

    sent: list[int]  #: to each neighbour
    received: list[int]  #: from each neighbour
    boundary: int  #: own bodies that other ranks need

    @classmethod
    def of(cls, held: Held, neighbours: Neighbourhood) -> HaloCapacity:
        """Capacities for the step after one with these held bodies, by the numbers of `neighbours`."""
        route = held.route
        counts = neighbours.renumber(route.neighbours, torch.tensor([route.sent, route.received]))
        sent, received = counts.tolist()
        return cls.after(sent, received, len(held.boundary), neighbours)

    @classmethod
    def after(cls, sent: list[int], received: list[int], boundary: int, neighbours: Neighbourhood) -> HaloCapacity:
        """Capacities for the next step, given this step's counts."""
        return cls(padded_counts(sent, neighbours), padded_counts(received, neighbours), padded_count(boundary))


def padded_count(count: int) -> int:
    """The capacity for a count."""
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE


def padded_counts(counts: Sequence[int], neighbours: Neighbourhood) -> list[int]:
    """Capacities for a count per destination; 0 for this rank, and for all that are not neighbours. Other neighbours
    have a capacity even if their count is 0: parts that meet at a corner share a body in some steps, none in others.
    """
    others = neighbours.others
    return [padded_count(count) if number in others else 0 for number, count in enumerate(counts)]


class PaddedHalo:
    """Exchange of ghosts in messages of fixed size. Does not synchronise if messages are sent on the stream. `announce`
    also sends the counts, with which `wait` removes the padding; `padded` keeps it.

    Args:
        decomposition: of space.
        capacity: padded counts of bodies.
        own: columns of this rank's own bodies.
        centres, kept: of own bodies, and min_separation and tolerance, as for `find_replicas`.
        boundary: (N,) int64: rows of own bodies that other ranks need, then -1.
        count: (1,) int64 on the device: their number.
    """

    def __init__(
        self,
        decomposition: Decomposition,
        capacity: HaloCapacity,
        own: Columns,
        centres: Centres,
        kept: tuple[float, float],
        boundary: Tensor,
        count: Tensor,
    ) -> None:
        self._comm, self._neighbours = decomposition.comm, decomposition.neighbours
        self._capacity, self._own = capacity, own
        self._boundary, self._count = boundary[: capacity.boundary], count
        self._where = decomposition, centres, kept

    def start(self) -> PaddedHalo:
        """Finds the bodies to send to each neighbour."""
        capacity = self._capacity
        self._replicas = find_replicas(*self._where, self._boundary)
        self._rows = self._replicas.rows_by_rank(self._boundary, capacity.sent)
        self._numbers = ops.counts_to_send(self._replicas.counts, capacity.sent, self._count, capacity.boundary)
        return self

    @property
    def overflow(self) -> Tensor:
        """(1,) int64: 1 if a capacity was exceeded, or a body reaches a rank that is not a neighbour; else 0."""
        return self._numbers[0, 1:]

    def announce(self) -> None:
        """Sends each neighbour its number of bodies, and all ranks whether a capacity was exceeded."""
        sent = self._numbers[:, 0].contiguous()
        overflows = self._comm.sum(self.overflow)
        self._messages = HostCopy.start(torch.cat([sent, self._neighbours.exchange_counts(sent), overflows]))

    def send(self) -> None:
        """Sends the bodies."""
        # Ids plus one, since padding is zeros.
        columns = self._own | {"id": self._own["id"] + 1}
        packed = pack(columns, self._rows)
        self._pending = self._neighbours.exchange(packed, self._capacity.sent, self._capacity.received)

    def padded(self) -> Held:
        """The held bodies, with padding: ghosts with id -1."""
        capacity, id = self._capacity, self._own["id"]
        route = Route(self._neighbours, self._rows, capacity.sent, capacity.received)
        ghosts = self._unpacked(self._pending.wait())
        return Held(id, ghosts, route, self._boundary, self._replicas)

    def _unpacked(self, packed: Tensor) -> Columns:
        ghosts = unpack(packed, self._own)
        return ghosts | {"id": ghosts["id"] - 1}

    def wait(self, boundary_count: int) -> Held | None:
        """The held bodies without padding; None, on all ranks, if the capacity of one of them was exceeded."""
        *counts, overflows = self._messages.numpy().tolist()
        packed = self._pending.wait()
        if overflows:
            return None
        sent, received = counts[: self._neighbours.size], counts[self._neighbours.size :]
        route = Route(self._neighbours, _filled(self._rows, self._capacity.sent, sent), sent, received)
        ghosts = self._unpacked(_filled(packed, self._capacity.received, received))
        replicas = Replicas(self._replicas.table[:boundary_count], self._replicas.counts)
        return Held(self._own["id"], ghosts, route, self._boundary[:boundary_count], replicas)


def _filled(rows: Tensor, capacities: list[int], counts: list[int]) -> Tensor:
    """The first `counts` rows of consecutive padded blocks."""
    parts = [part[:count] for part, count in zip(torch.split(rows, capacities), counts, strict=True) if count]
    return torch.cat(parts) if parts else rows[:0]
