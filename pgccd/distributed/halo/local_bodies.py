"""The bodies that a rank holds for one step: its own, and ghosts."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.distributed.comm.exchange import Columns, Route
from pgccd.distributed.halo.replicas import Replicas


@dataclass(frozen=True)
class LocalBodies:
    """The bodies a rank holds for one step: rows 0 to N - 1 are its own, rows N to N + G - 1 ghosts."""

    own_id: Tensor  #: (N,) int64, ascending
    #: Columns of G bodies, "id" among them, in order of arrival: by owner, then by id; padding, of id -1, follows those
    #: of each owner.
    ghosts: Columns
    route: Route  #: route by which ghosts were sent: its rows index own bodies
    boundary: Tensor  #: (B,) int64, ascending: rows of own bodies that other ranks hold too; then -1 for padding
    replicas: Replicas  #: the other ranks that hold each boundary body

    def __len__(self) -> int:
        return self.own_count + self.ghost_count

    @property
    def own_count(self) -> int:
        return len(self.own_id)

    @property
    def ghost_count(self) -> int:
        return len(self.ghosts["id"])

    def ghosts_by_source(self) -> Tensor:
        """(neighbours.size,) int64 on the device: number of ghosts, without padding, from each neighbour."""
        is_ghost = (self.ghosts["id"] >= 0).to(torch.int64)
        return torch.zeros_like(self.replicas.counts).scatter_add_(0, self.route.source, is_ghost)

    @functools.cached_property
    def id(self) -> Tensor:
        """(N + G,) int64."""
        return torch.cat([self.own_id, self.ghosts["id"]])

    @functools.cached_property
    def owner(self) -> Tensor:
        """(N + G,) int64: the rank that owns each, as numbered in `route.neighbours`."""
        return torch.cat([torch.full_like(self.own_id, self.route.neighbours.rank), self.route.source])
