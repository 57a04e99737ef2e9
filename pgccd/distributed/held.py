"""The bodies that a rank holds for one step: its own, and ghosts of others'."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.detection.bodies import MovingBodies
from pgccd.distributed.comm.exchange import Columns, Route
from pgccd.distributed.comm.interface import Comm

#: SBV centres at t0 and t1 (N, 3) of bodies, and how far they reach from the way between these (N,).
Centres = tuple[Tensor, Tensor, Tensor]


def centres_of(bodies: MovingBodies) -> Centres:
    """Of moving bodies."""
    return bodies.centre_t0, bodies.centre_t1, bodies.reach


@dataclass(frozen=True)
class Held:
    """The bodies a rank holds for one step: rows 0 to N - 1 are its own, rows N to N + G - 1 ghosts."""

    own_id: Tensor  #: (N,) int64, ascending
    ghosts: Columns  #: of G bodies, "id" among them, in the order in which they came: by owner, then by id
    route: Route  #: that brought them: its rows count own bodies
    boundary: Tensor  #: (B,) int64, ascending: rows of own bodies that others hold too
    replica_ranks: Tensor  #: (B, ranks) uint8: 1 for each of these others
    boundary_counts: Tensor  #: (ranks,) int64: how many of these bodies each of them holds

    @classmethod
    def alone(cls, comm: Comm, own: Columns) -> Held:
        """Of the only rank: there are no ghosts."""
        id, ghosts = own["id"], {name: column[:0] for name, column in own.items()}
        replica_ranks = id.new_empty((0, 1), dtype=torch.uint8)
        return cls(id, ghosts, Route(comm, id[:0], [0], [0]), id[:0], replica_ranks, id.new_zeros(1))

    def __len__(self) -> int:
        return self.own_count + self.ghost_count

    @property
    def own_count(self) -> int:
        return len(self.own_id)

    @property
    def ghost_count(self) -> int:
        return len(self.ghosts["id"])

    @functools.cached_property
    def id(self) -> Tensor:
        """(N + G,) int64."""
        return torch.cat([self.own_id, self.ghosts["id"]])

    @functools.cached_property
    def owner(self) -> Tensor:
        """(N + G,) int64: the rank that owns each."""
        return torch.cat([torch.full_like(self.own_id, self.route.comm.rank), self.route.source])
