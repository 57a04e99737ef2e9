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
from pgccd.distributed.comm.exchange import Columns, Route
from pgccd.distributed.comm.interface import Pending
from pgccd.distributed.halo.capacity import HaloCapacity, PaddedHalo
from pgccd.distributed.halo.centres import centres_of
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.replicas import agreed_replicas
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.host_copy import HostCopy


class Halo:
    """The ghosts of one step: `find_boundary`, then `send` or `send_padded`, then `wait`.

    Args:
        decomposition: of space.
        own: columns of this rank's own bodies to send, "id" ascending.
        bodies: the own bodies and their motion, not validated yet.
        kept: min_separation and tolerance, as the operators take them.
    """

    def __init__(
        self,
        decomposition: Decomposition,
        own: Mapping[str, Tensor],
        bodies: MovingBodies,
        kept: tuple[float, float],
    ) -> None:
        self._decomposition, self._own, self._bodies = decomposition, dict(own), bodies
        self._is_alone = decomposition.comm.size == 1
        self._where = centres_of(bodies), kept
        none_of_them = own["id"][:0]
        #: (N,) uint8: 1 for own bodies that reach cells of other ranks.
        self.reach = none_of_them.to(torch.uint8)
        #: (B,) int64: rows of these bodies.
        self._boundary = none_of_them
        self._arrival: Pending[Columns] | None = None
        self._padded: PaddedHalo | None = None

    def find_boundary(self) -> None:
        """Finds the bodies that other ranks need. Does not synchronise."""
        found = self._bodies._first_faults()
        if not self._is_alone:
            centres, kept = self._where
            where = *kept, *self._decomposition.subdomain
            self.reach, self._boundary, self._count = ops.boundary_bodies(centres, *where)
            found = torch.cat([self._count, found])
        self._found = HostCopy.start(found)

    def check(self) -> None:
        """Reads the count of boundary bodies and the faults. Synchronises.

        Raises:
            ValueError: a pose is invalid.
        """
        if self._bodies.checked:
            return
        count, *faults = ([0] if self._is_alone else []) + self._found.numpy().tolist()
        self._bodies._raise_faults(faults)
        self._bodies.checked = True
        self._boundary = self._boundary[:count]

    def send_padded(self, capacity: HaloCapacity) -> None:
        """Sends ghosts without synchronising. If the capacity of a rank is exceeded, `wait` sends them again."""
        bodies = self._own, *self._where, self._boundary, self._count
        self._padded = PaddedHalo(self._decomposition, capacity, *bodies).start()
        self._padded.announce()
        self._padded.send()

    def send(self) -> None:
        """Sends ghosts after exchanging counts. Validates the bodies first, if not done yet."""
        self.check()
        self._replicas = agreed_replicas(self._decomposition, *self._where, self._boundary)
        neighbours = self._decomposition.neighbours
        sent, received = neighbours.agree(self._replicas.counts)
        self._route = Route(neighbours, self._replicas.rows_by_rank(self._boundary, sent), sent, received)
        self._arrival = self._route.forward(self._own)

    def wait(self) -> Held:
        """The held bodies, once all ghosts have arrived. Sends ghosts first, if not done yet."""
        self.check()
        if self._is_alone:
            return Held.alone(self._decomposition.neighbours, self._own)
        if self._padded is not None:
            held, self._padded = self._padded.wait(len(self._boundary)), None
            if held is not None:
                return held
        if self._arrival is None:
            self.send()
        assert self._arrival is not None
        return Held(self._own["id"], self._arrival.wait(), self._route, self._boundary, self._replicas)
