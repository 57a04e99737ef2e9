"""Ghosts of one step: copies of other ranks' bodies that reach a cell of this rank.

A body is sent to every rank that owns a cell overlapped by its CBV's box (many cells near corners, or for a fast body).
Two boxes that overlap share the lower corner of their intersection; the rank that owns the cell of this reference point
holds both bodies, since the point lies in both boxes, and tests the pair. It may own neither.

Most bodies reach only cells of their own rank. One pass finds the rest; all further work is proportional to their
number.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.exchange import Route, unpack
from pgccd.distributed.comm.interface import Pending
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.local_bodies import LocalBodies
from pgccd.distributed.halo.replicas import Replicas, agreed_replicas, find_replicas
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.attempts import TooSmall, until_it_fits
from pgccd.runtime.host_copy import HostCopy
from pgccd.search.bodies import MovingBodies


class Halo:
    """The ghosts of one step: `find_boundary`, then `send`, then `wait`.

    Args:
        decomposition: of space.
        own: columns of this rank's own bodies to send, "id" ascending; rows with id -1 may follow.
        bodies: the own bodies and their motion, not validated yet.
        distances: min_separation and tolerance, as the operators take them.
        sizes: capacities of the messages, in which unused rows are padding: ghosts of zeros, with id -1. `send` does
            not synchronise then, if messages are sent on the stream. Default: exact sizes, on which ranks agree.
        synchronises: whether `wait` validates the bodies, and sends ghosts again, with exact sizes, if a rank has more
            than `sizes`. Otherwise nothing synchronises, and ghosts are missing where there is `overflow`.
    """

    def __init__(
        self,
        decomposition: Decomposition,
        own: Mapping[str, Tensor],
        bodies: MovingBodies,
        distances: tuple[float, float],
        sizes: HaloSizes | None = None,
        synchronises: bool = True,
    ) -> None:
        self._decomposition, self._own, self._bodies = decomposition, dict(own), bodies
        self._sizes, self._synchronises = sizes, synchronises
        self._is_alone = decomposition.comm.size == 1
        self._where = bodies.swept_spheres, distances
        none_of_them = own["id"][:0]
        #: (N,) uint8: 1 for own bodies that reach cells of other ranks.
        self.reach = none_of_them.to(torch.uint8)
        #: (1,) int64: 1 if a capacity was exceeded, or a body reaches a rank that is not a neighbour; else 0.
        self.overflow = none_of_them.new_zeros(1)
        # (N,) int64: rows of the bodies at the boundary, then -1; and their number, (1,).
        self._boundary, self._count = none_of_them, self.overflow
        self._pending: Pending[Tensor] | None = None
        self._held: LocalBodies | None = None

    @property
    def is_padded(self) -> bool:
        """Whether there may be padding among the ghosts."""
        return self._sizes is not None

    def find_boundary(self) -> None:
        """Finds the bodies that other ranks need. Does not synchronise."""
        if not self._is_alone:
            centres, distances = self._where
            frame, owner, rank = self._decomposition.subdomain
            self.reach, self._boundary, self._count = ops.boundary_bodies(centres, *distances, frame, owner, rank)
        if self._synchronises:
            self._found = HostCopy.start(torch.cat([self._count, self._bodies._first_invalid_rows()]))

    def send(self) -> None:
        """Sends ghosts. With exact sizes this validates the bodies, agrees with other ranks, and synchronises."""
        if self._sizes is None:
            rows = self._boundary[: self._check()]
            replicas = agreed_replicas(self._decomposition, *self._where, rows)
            sent, received = self._decomposition.neighbours.agree(replicas.counts)
        else:
            sent, received, capacity = self._sizes.sent, self._sizes.received, self._sizes.boundary
            rows = self._boundary[:capacity]
            replicas = find_replicas(self._decomposition, *self._where, rows)
            self.overflow = replicas.overflow(sent, self._count, capacity)
            if self._synchronises:
                overflows = self._decomposition.comm.sum(self.overflow)
                self._sent = HostCopy.start(torch.cat([overflows, replicas.counts]))
        self._at_boundary = rows, replicas
        self._route = Route(self._decomposition.neighbours, replicas.rows_by_rank(rows, sent), sent, received)
        # Ids plus one, since padding is zeros.
        self._pending = self._route.send(self._own | {"id": self._own["id"] + 1})

    def wait(self) -> LocalBodies:
        """The held bodies, once all ghosts have arrived. Sends ghosts first, if not done yet.

        Raises:
            ValueError: if it `synchronises`: a pose is invalid.
        """
        if self._held is None:
            if self._synchronises:
                self._check()
            self._held = self._alone() if self._is_alone else until_it_fits(self._arrived, self._sizes)
        return self._held

    def _arrived(self, sizes: HaloSizes | None) -> LocalBodies | TooSmall[HaloSizes | None]:
        if self._pending is None:
            self._sizes = sizes
            self.send()
        assert self._pending is not None
        packed, self._pending = self._pending.wait(), None
        if sizes is not None and self._synchronises and self._sent.numpy()[0]:
            return TooSmall(None)
        ghosts = unpack(packed, self._own)
        ghosts["id"] = ghosts["id"] - 1
        return LocalBodies(self._own["id"], ghosts, self._route, *self._at_boundary)

    def _alone(self) -> LocalBodies:
        none = Replicas(self._boundary.new_empty((0, 1), dtype=torch.uint8), self._count)
        ghosts = {name: column[:0] for name, column in self._own.items()}
        self._route = Route(self._decomposition.neighbours, self._boundary, [0], [0])
        return LocalBodies(self._own["id"], ghosts, self._route, self._boundary, none)

    def sizes(self, near: int, received: list[int]) -> HaloSizes:
        """The numbers of bodies of this step, if it `synchronises`, after `wait`.

        Args:
            near: number of own bodies near ghosts or at the boundary.
            received: number of ghosts from each neighbour.
        """
        sent = self._route.sent if self._sizes is None else self._sent.numpy()[1:].tolist()
        return HaloSizes(self._route.neighbours, sent, received, self._check(), near)

    def _check(self) -> int:
        """Validates the bodies, and returns the number of those at the boundary. Synchronises."""
        count, *invalid_rows = self._found.numpy().tolist()
        self._bodies._raise_invalid(invalid_rows)
        return count
