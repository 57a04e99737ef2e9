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
from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import Route, unpack
from pgccd.distributed.comm.interface import Pending
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.replicas import Replicas, agreed_replicas, find_replicas
from pgccd.distributed.halo.sizes import HaloSizes
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.host_copy import HostCopy


class Halo:
    """The ghosts of one step: `find_boundary`, then `send`, then `wait`.

    Args:
        decomposition: of space.
        own: columns of this rank's own bodies to send, "id" ascending; rows with id -1 may follow.
        bodies: the own bodies and their motion, not validated yet.
        kept: min_separation and tolerance, as the operators take them.
        sizes: capacities of the messages, in which unused rows are padding: ghosts of zeros, with id -1. Then nothing
            synchronises, if messages are sent on the stream, and the bodies are not validated. Default: exact sizes,
            on which ranks agree.
    """

    def __init__(
        self,
        decomposition: Decomposition,
        own: Mapping[str, Tensor],
        bodies: MovingBodies,
        kept: tuple[float, float],
        sizes: HaloSizes | None = None,
    ) -> None:
        self._decomposition, self._own, self._bodies, self._sizes = decomposition, dict(own), bodies, sizes
        self._is_alone = decomposition.comm.size == 1
        self._where = bodies.swept_spheres, kept
        none_of_them = own["id"][:0]
        #: (N,) uint8: 1 for own bodies that reach cells of other ranks.
        self.reach = none_of_them.to(torch.uint8)
        #: (1,) int64 on the device: number of these bodies.
        self.boundary_count = none_of_them.new_zeros(1)
        #: (1,) int64: 1 if a capacity was exceeded, or a body reaches a rank that is not a neighbour; else 0.
        self.overflow = self.boundary_count
        # (B,) int64: rows of the bodies at the boundary.
        self._boundary = none_of_them
        self._pending: Pending[Tensor] | None = None
        self._held: Held | None = None

    def find_boundary(self) -> None:
        """Finds the bodies that other ranks need. Does not synchronise."""
        if not self._is_alone:
            centres, kept = self._where
            where = *kept, *self._decomposition.subdomain
            self.reach, self._boundary, self.boundary_count = ops.boundary_bodies(centres, *where)
        if self._sizes is None:
            self._found = HostCopy.start(torch.cat([self.boundary_count, self._bodies.first_faults()]))

    def send(self) -> None:
        """Sends ghosts. With exact sizes this validates the bodies, agrees with other ranks, and synchronises."""
        neighbours = self._decomposition.neighbours
        if self._sizes is None:
            self._check()
            self._replicas = agreed_replicas(self._decomposition, *self._where, self._boundary)
            neighbours = self._decomposition.neighbours  # may have been extended
            sent, received = neighbours.agree(self._replicas.counts)
        else:
            sent, received, boundary = self._sizes.sent, self._sizes.received, self._sizes.boundary
            self._boundary = self._boundary[:boundary]
            self._replicas = find_replicas(self._decomposition, *self._where, self._boundary)
            self.overflow = self._replicas.overflow(sent, self.boundary_count, boundary)
        self._route = Route(neighbours, self._replicas.rows_by_rank(self._boundary, sent), sent, received)
        # Ids plus one, since padding is zeros.
        self._pending = self._route.send(self._own | {"id": self._own["id"] + 1})

    def wait(self) -> Held:
        """The held bodies, once all ghosts have arrived. Sends ghosts first, if not done yet.

        Raises:
            ValueError: with exact sizes, if a pose is invalid.
        """
        if self._held is None:
            self._held = self._wait_alone() if self._is_alone else self._wait()
        return self._held

    def _wait(self) -> Held:
        if self._pending is None:
            self.send()
        assert self._pending is not None
        ghosts = unpack(self._pending.wait(), self._own)
        return Held(self._own["id"], ghosts | {"id": ghosts["id"] - 1}, self._route, self._boundary, self._replicas)

    def _wait_alone(self) -> Held:
        if self._sizes is None:
            self._check()
        none = Replicas(self._boundary.new_empty((0, 1), dtype=torch.uint8), self.boundary_count)
        ghosts = {name: column[:0] for name, column in self._own.items()}
        route = Route(self._decomposition.neighbours, self._boundary, [0], [0])
        return Held(self._own["id"], ghosts, route, self._boundary, none)

    def _check(self) -> None:
        """Reads the number of bodies at the boundary, and the faults. Synchronises."""
        count, *faults = self._found.numpy().tolist()
        self._bodies.raise_faults(faults)
        self._bodies.checked = True
        self._boundary = self._boundary[:count]
