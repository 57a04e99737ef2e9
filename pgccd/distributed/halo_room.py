"""Ghosts in messages whose sizes are known before: with room for somewhat more than in the last step.

Otherwise ranks must tell one another how many are to come, and the host must know, before they can be sent. It would
come to that while a GPU is busy with own pairs, and the few small messages would have to wait for its multiprocessors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns, Route, pack, unpack
from pgccd.host_copy import HostCopy

# Room is for so many times more, and for some more where there are few; and a multiple of a number, so that buffers
# have the same sizes from step to step.
_SLACK, _SOME, _MULTIPLE = 1.25, 64, 256


@dataclass(frozen=True)
class Room:
    """For how many bodies there is room. Both ends of a message know it from the last step."""

    sent: list[int]  #: to each rank
    received: list[int]  #: from each
    boundary: int  #: own bodies that others need

    @classmethod
    def after(cls, sent: list[int], received: list[int], boundary: int) -> Room:
        """Of the next step, if so many were sent, received and needed in this one."""
        return cls([_room(count) for count in sent], [_room(count) for count in received], _room(boundary))


def _room(count: int) -> int:
    # Ranks that were no neighbours send one another nothing.
    return -(-int(_SLACK * count + _SOME) // _MULTIPLE) * _MULTIPLE if count else 0


@dataclass(frozen=True)
class Sent:
    """What there was room for."""

    route: Route
    ghosts: Columns
    replica_ranks: Tensor  #: (B, ranks) uint8: which ranks hold each of the own bodies that others need
    counts: Tensor  #: (ranks,) int64: how many each holds


class SentWithin:
    """Ghosts on their way, and their number with them. Nothing waits, where messages go with the stream.

    Args:
        comm: between the ranks.
        room: what fits.
        own: columns of this rank's own bodies.
        where: centres of these, separation, tolerance, and the subdomain, as for `pgccd.ops.replica_ranks`.
        boundary: (N,) int64: rows of those that others need, then rows of -1.
        count: (1,) int64, left on the device: how many these are.
    """

    def __init__(
        self,
        comm: Comm,
        room: Room,
        own: Columns,
        where: tuple[tuple[Tensor, Tensor, Tensor], float, float, ops.Subdomain],
        boundary: Tensor,
        count: Tensor,
    ) -> None:
        self._comm, self._room, self._own = comm, room, own
        boundary = boundary[: room.boundary]
        self._replica_ranks, self._counts = ops.replica_ranks(*where, boundary, comm.size)
        self._rows = ops.rows_by_rank(self._replica_ranks, boundary, self._counts, room.sent)
        # Each rank tells all others whether it is short of room.
        told = ops.counts_to_tell(self._counts, room.sent, count, room.boundary)
        self._told = HostCopy(torch.stack([told, comm.exchange_counts(told)]))
        self._pending = comm.exchange(pack(own, self._rows), room.sent, room.received)

    def wait(self, boundary_count: int) -> Sent | None:
        """What was sent; None, on all ranks, if one of them was short of room."""
        told = self._told.numpy()
        packed = self._pending.wait()
        if told[:, :, 1].any():
            return None
        sent, received = told[:, :, 0].tolist()
        route = Route(self._comm, _filled(self._rows, self._room.sent, sent), sent, received)
        ghosts = unpack(_filled(packed, self._room.received, received), self._own)
        return Sent(route, ghosts, self._replica_ranks[:boundary_count], self._counts)


def _filled(rows: Tensor, rooms: list[int], counts: list[int]) -> Tensor:
    """Of rows in several rooms, one after the other, so many of each."""
    parts = [part[:count] for part, count in zip(torch.split(rows, rooms), counts, strict=True) if count]
    return torch.cat(parts) if parts else rows[:0]
