"""What a rank must know of others' bodies for one step: ghosts of all that reach a cell of its own.

A body is sent to every rank that owns any cell its CBV's box reaches (corners touch many cells, a fast body too). Two
boxes that overlap share the lower corner of their intersection; the rank that owns the cell of that reference point
holds both bodies, since the point lies in both boxes, and is the one that tests the pair. It may own neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.broad import check_separation
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Arrival, Columns, Route, make_route, merge_columns, merged_rows
from pgccd.distributed.partition import Partition, ranks_reached
from pgccd.motion import RigidMotion


@dataclass(frozen=True)
class Boxes:
    """Boxes of bodies' CBVs and the cells they reach."""

    lower: Tensor  #: (N, 3) float64, min_separation / 2 included, rounded outward
    upper: Tensor  #: (N, 3)
    first: Tensor  #: (N, 3) int64: the cell along each axis of the lower corner
    last: Tensor  #: (N, 3) of the upper corner

    @classmethod
    def of(cls, partition: Partition, motion: RigidMotion, radius: Tensor, min_separation: float = 0.0) -> Boxes:
        """Those of a motion's bodies with SBV radius (N,)."""
        motion.check()
        separation = check_separation(min_separation)
        lower, upper = ops.swept_boxes(motion.position_t0, motion.position_t1, radius, separation)
        return cls(lower, upper, partition.coordinates(lower), partition.coordinates(upper))

    def reference_cell(self, partition: Partition, pairs: Tensor) -> Tensor:
        """(P,) int64: the cell of the lower corner of the intersection of each pair (P, 2)."""
        return partition.cell_of(torch.maximum(self.lower[pairs[:, 0]], self.lower[pairs[:, 1]]))


@dataclass(frozen=True)
class Held:
    """The bodies a rank holds for one step: its own and ghosts. Rows ascend by global id, so that pairs of rows are in
    the order of their ids, on every rank alike."""

    columns: Columns  #: of all of them, "id" among them
    owner: Tensor  #: (H,) int64: the rank that owns each
    own: Tensor  #: (N,) int64: rows of this rank's own bodies
    ghosts: Tensor  #: (G,) int64: rows of ghosts, in the order in which they came
    route: Route  #: that brought the ghosts: its rows count own bodies

    def __len__(self) -> int:
        return self.owner.shape[0]

    def first_toi(self, toi: Tensor) -> Tensor:
        """The smallest toi (H,) of each body over all ranks that hold it (`pgccd.sim.Exchange`)."""
        found = self.route.back({"toi": toi[self.ghosts]}).wait()["toi"]
        least = toi[self.own].scatter_reduce(0, self.route.rows, found, "amin")
        toi = toi.clone()
        toi[self.own] = least
        toi[self.ghosts] = self.route.forward({"toi": least}).wait()["toi"]
        return toi

    def any(self, flag: bool) -> bool:
        """True if it is on any rank (`pgccd.sim.Exchange`)."""
        return self.route.comm.any(flag)


class Halo:
    """The ghosts of one step, under way from construction on.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        own: columns of this rank's own bodies, "id" ascending.
        boxes: of theirs.
    """

    def __init__(self, comm: Comm, partition: Partition, own: Mapping[str, Tensor], boxes: Boxes) -> None:
        self._own = dict(own)
        body, destination = ranks_reached(partition, boxes.first, boxes.last, comm.rank)
        self._route = make_route(comm, body, destination)
        self._arrival: Arrival = self._route.forward(own)

    def wait(self) -> Held:
        """The bodies held, once all ghosts are here."""
        ghosts = self._arrival.wait()
        own, came = rows = merged_rows(self._own["id"], ghosts["id"])
        columns = merge_columns(self._own, ghosts, rows)
        owner = torch.full_like(columns["id"], self._route.comm.rank)
        owner[came] = self._route.source
        return Held(columns, owner, own, came, self._route)
