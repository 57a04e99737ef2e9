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
    def after(cls, sent: list[int], received: list[int], boundary: int) -> HaloCapacity:
        """Of the next step, if so many were sent, received and needed in this one."""
        return cls(
            [_padded_count(count) for count in sent],
            [_padded_count(count) for count in received],
            _padded_count(boundary),
        )


def _padded_count(count: int) -> int:
    # Ranks that were no neighbours send one another nothing.
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE if count else 0


@dataclass(frozen=True)
class Sent:
    """Ghosts, and the bodies sent, without padding."""

    route: Route
    ghosts: Columns
    replica_ranks: Tensor  #: (B, ranks) uint8: which ranks hold each of the own bodies that others need
    counts: Tensor  #: (ranks,) int64: how many each holds


class PaddedHalo:
    """Ghosts on their way, and their number with them. Nothing waits, where messages go with the stream.

    Args:
        comm: between the ranks.
        capacity: padded counts of bodies.
        own: columns of this rank's own bodies.
    """

    def __init__(self, comm: Comm, capacity: HaloCapacity, own: Columns) -> None:
        self._comm, self._capacity, self._own = comm, capacity, own

    def send(
        self,
        where: tuple[tuple[Tensor, Tensor, Tensor], float, float, ops.Subdomain],
        boundary: Tensor,
        count: Tensor,
    ) -> None:
        """Sends own bodies that others need.

        Args:
            where: centres of own bodies, separation, tolerance, and the subdomain, as for `pgccd.ops.replica_ranks`.
            boundary: (N,) int64: rows of those that others need, then rows of -1.
            count: (1,) int64, left on the device: how many these are.
        """
        comm, capacity = self._comm, self._capacity
        boundary = boundary[: capacity.boundary]
        self._replica_ranks, self._counts = ops.replica_ranks(*where, boundary, comm.size)
        self._rows = ops.rows_by_rank(self._replica_ranks, boundary, self._counts, capacity.sent)
        # Each rank sends all others whether its capacity was exceeded.
        messages = ops.counts_to_send(self._counts, capacity.sent, count, capacity.boundary)
        self._messages = HostCopy.start(torch.stack([messages, comm.exchange_counts(messages)]))
        self._pending = comm.exchange(pack(self._own, self._rows), capacity.sent, capacity.received)

    def wait(self, boundary_count: int) -> Sent | None:
        """What was sent; None, on all ranks, if the capacity of one of them was exceeded."""
        messages = self._messages.numpy()
        packed = self._pending.wait()
        if messages[:, :, 1].any():
            return None
        sent, received = messages[:, :, 0].tolist()
        route = Route(self._comm, _filled(self._rows, self._capacity.sent, sent), sent, received)
        ghosts = unpack(_filled(packed, self._capacity.received, received), self._own)
        return Sent(route, ghosts, self._replica_ranks[:boundary_count], self._counts)


def _filled(rows: Tensor, capacities: list[int], counts: list[int]) -> Tensor:
    """The first `counts` rows of consecutive padded blocks."""
    parts = [part[:count] for part, count in zip(torch.split(rows, capacities), counts, strict=True) if count]
    return torch.cat(parts) if parts else rows[:0]
