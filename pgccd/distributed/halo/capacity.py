"""Ghosts in messages of fixed size: padded to somewhat more than in the last step.

Otherwise ranks must exchange counts, and the host must read them, before ghosts can be sent. It would
come to that while a GPU is busy with own pairs, and the few small messages would have to wait for its multiprocessors.
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
# keep their sizes from step to step.
_SLACK, _SOME, _MULTIPLE = 1.25, 64, 256


@dataclass(frozen=True)
class HaloCapacity:
    """Padded counts of bodies in messages. Both ends of a message derive them from the last step."""

    sent: list[int]  #: to each rank
    received: list[int]  #: from each
    boundary: int  #: own bodies that others need

    @classmethod
    def of(cls, held: Held) -> HaloCapacity:
        """Of the step after one with these bodies."""
        return cls.after(held.route.sent, held.route.received, len(held.boundary))

    @classmethod
    def after(cls, sent: list[int], received: list[int], boundary: int) -> HaloCapacity:
        """Of the next step, if so many were sent, received and needed in this one."""
        return cls(
            [padded_count(count) for count in sent],
            [padded_count(count) for count in received],
            padded_count(boundary),
        )


def padded_count(count: int) -> int:
    """Somewhat more; none of none."""
    # Ranks that were no neighbours send one another nothing.
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE if count else 0


@dataclass(frozen=True)
class Sent:
    """Ghosts, and the bodies sent, without padding."""

    route: Route
    ghosts: Columns
    replicas: ReplicaTable  #: of the own bodies that others need


class PaddedHalo:
    """Ghosts on their way in messages of fixed size: `find_ranks`, then `send`. Nothing waits, where messages go with
    the stream. `announce` sends their numbers too, by which `wait` removes the padding; `padded` leaves it.

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
        """Finds out which ranks need which of the own bodies.

        Args:
            where: centres of own bodies, distances kept, and the subdomain, as for `find_replicas`.
            boundary: (N,) int64: rows of those that others need, then rows of -1.
            count: (1,) int64, left on the device: how many these are.
        """
        comm, capacity = self._comm, self._capacity
        self._boundary = boundary[: capacity.boundary]
        centres, kept, subdomain = where
        replicas = ReplicaTable(*ops.replica_ranks(centres, *kept, subdomain, self._boundary, comm.size))
        self._rows = replicas.rows_by_rank(self._boundary, capacity.sent)
        self._numbers = ops.counts_to_send(replicas.counts, capacity.sent, count, capacity.boundary)
        self._replicas = replicas

    @property
    def overflow(self) -> Tensor:
        """(1,) int64: 1 if a capacity of this rank was exceeded, else 0."""
        return self._numbers[0, 1:]

    def announce(self) -> None:
        """Tells each rank how many bodies come, and all of them whether a capacity was exceeded."""
        self._messages = HostCopy.start(torch.stack([self._numbers, self._comm.exchange_counts(self._numbers)]))

    def send(self) -> None:
        """Sends the bodies."""
        # One more, since padding is zeros.
        columns = self._own | {"id": self._own["id"] + 1}
        packed = pack(columns, self._rows)
        self._pending = self._comm.exchange(packed, self._capacity.sent, self._capacity.received)

    def padded(self) -> Held:
        """The bodies held, among them padding: ghosts whose id is -1."""
        capacity, id = self._capacity, self._own["id"]
        route = Route(self._comm, self._rows, capacity.sent, capacity.received)
        ghosts = self._unpacked(self._pending.wait())
        return Held(id, ghosts, route, self._boundary, self._replicas)

    def _unpacked(self, packed: Tensor) -> Columns:
        ghosts = unpack(packed, self._own)
        return ghosts | {"id": ghosts["id"] - 1}

    def wait(self, boundary_count: int) -> Sent | None:
        """What was sent; None, on all ranks, if the capacity of one of them was exceeded."""
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
