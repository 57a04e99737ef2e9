"""Ghosts in messages of fixed size, padded relative to the last step.

Otherwise ranks would have to exchange counts through the host before sending ghosts; by then the GPU would be busy with
own pairs, and these small messages would wait for free multiprocessors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.exchange import Columns, Route, pack, unpack
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo.centres import Centres
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.replicas import ReplicaTable
from pgccd.runtime.host_copy import HostCopy

# A capacity is the last count times _SLACK plus _SOME (for small counts), rounded up to a multiple, so that buffers
# rarely change size.
_SLACK, _SOME, _MULTIPLE = 1.25, 64, 256


@dataclass(frozen=True)
class HaloCapacity:
    """Padded counts of bodies in messages. Both ends of a message compute them from the last step."""

    sent: list[int]  #: to each rank
    received: list[int]  #: from each rank
    boundary: int  #: own bodies that other ranks need

    @classmethod
    def of(cls, held: Held) -> HaloCapacity:
        """Capacities for the step after one with these held bodies."""
        return cls.after(held.route.sent, held.route.received, len(held.boundary))

    @classmethod
    def after(cls, sent: list[int], received: list[int], boundary: int) -> HaloCapacity:
        """Capacities for the next step, given this step's counts."""
        return cls(
            [padded_count(count) for count in sent],
            [padded_count(count) for count in received],
            padded_count(boundary),
        )


def padded_count(count: int) -> int:
    """The capacity for a count; 0 for 0."""
    # Ranks that were not neighbours send each other nothing.
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE if count else 0


@dataclass(frozen=True)
class Sent:
    """Received ghosts and the bodies sent, without padding."""

    route: Route
    ghosts: Columns
    replicas: ReplicaTable  #: of the own bodies that other ranks need


class PaddedHalo:
    """Exchange of ghosts in messages of fixed size: `find_ranks`, then `send`. Does not synchronise if messages are
    sent on the stream. `announce` also sends the counts, with which `wait` removes the padding; `padded` keeps it.

    Args:
        comm: between the ranks.
        capacity: padded counts of bodies.
        own: columns of this rank's own bodies.
    """

    def __init__(self, comm: Comm, capacity: HaloCapacity, own: Columns) -> None:
        self._comm, self._capacity, self._own = comm, capacity, own

    def find_ranks(
        self,
        where: tuple[Centres, tuple[float, float], ops.Subdomain],
        boundary: Tensor,
        count: Tensor,
    ) -> None:
        """Finds the ranks that need each own body.

        Args:
            where: centres of own bodies, min_separation and tolerance, and the subdomain, as for `find_replicas`.
            boundary: (N,) int64: rows of own bodies that other ranks need, then -1.
            count: (1,) int64 on the device: their number.
        """
        comm, capacity = self._comm, self._capacity
        self._boundary = boundary[: capacity.boundary]
        centres, kept, subdomain = where
        reach = *kept, *subdomain
        replicas = ReplicaTable(*ops.replica_ranks(centres, *reach, self._boundary, [], comm.size))
        self._rows = replicas.rows_by_rank(self._boundary, capacity.sent)
        self._numbers = ops.counts_to_send(replicas.counts, capacity.sent, count, capacity.boundary)
        self._replicas = replicas

    @property
    def overflow(self) -> Tensor:
        """(1,) int64: 1 if a capacity of this rank was exceeded, else 0."""
        return self._numbers[0, 1:]

    def announce(self) -> None:
        """Sends each rank its number of bodies, and all ranks whether a capacity was exceeded."""
        self._messages = HostCopy.start(torch.stack([self._numbers, self._comm.exchange_counts(self._numbers)]))

    def send(self) -> None:
        """Sends the bodies."""
        # Ids plus one, since padding is zeros.
        columns = self._own | {"id": self._own["id"] + 1}
        packed = pack(columns, self._rows)
        self._pending = self._comm.exchange(packed, self._capacity.sent, self._capacity.received)

    def padded(self) -> Held:
        """The held bodies, with padding: ghosts with id -1."""
        capacity, id = self._capacity, self._own["id"]
        route = Route(self._comm, self._rows, capacity.sent, capacity.received)
        ghosts = self._unpacked(self._pending.wait())
        return Held(id, ghosts, route, self._boundary, self._replicas)

    def _unpacked(self, packed: Tensor) -> Columns:
        ghosts = unpack(packed, self._own)
        return ghosts | {"id": ghosts["id"] - 1}

    def wait(self, boundary_count: int) -> Sent | None:
        """The ghosts without padding; None, on all ranks, if the capacity of one of them was exceeded."""
        messages = self._messages.numpy()
        packed = self._pending.wait()
        if messages[:, :, 1].any():
            return None
        sent, received = messages[:, :, 0].tolist()
        route = Route(self._comm, _filled(self._rows, self._capacity.sent, sent), sent, received)
        ghosts = self._unpacked(_filled(packed, self._capacity.received, received))
        of_boundary = ReplicaTable(self._replicas.table[:boundary_count], self._replicas.counts)
        return Sent(route, ghosts, of_boundary)


def _filled(rows: Tensor, capacities: list[int], counts: list[int]) -> Tensor:
    """The first `counts` rows of consecutive padded blocks."""
    parts = [part[:count] for part, count in zip(torch.split(rows, capacities), counts, strict=True) if count]
    return torch.cat(parts) if parts else rows[:0]
