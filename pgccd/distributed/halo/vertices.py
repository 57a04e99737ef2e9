"""Per-vertex columns of deforming bodies, sent between ranks with the bodies."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.distributed.comm.exchange import Columns, Route, pack, take_rows, unpack
from pgccd.geometry.mesh_set import MeshSet


@dataclass(frozen=True)
class Vertices:
    """Vertices of bodies: those of the first, in the order of its mesh, then those of the second, and so on."""

    columns: Columns  #: by name: (X, ...)
    count: Tensor  #: (N,) int64: number of vertices of each body

    def __post_init__(self) -> None:
        for name, column in self.columns.items():
            if len(column) != int(self.count.sum()):
                raise ValueError(f"{name}: expected a row for each of {int(self.count.sum())} vertices")

    @classmethod
    def join(cls, first: Vertices, second: Vertices) -> Vertices:
        """The vertices of the bodies of both."""
        columns = {name: torch.cat([column, second.columns[name]]) for name, column in first.columns.items()}
        return cls(columns, torch.cat([first.count, second.count]))

    def rows(self, bodies: Tensor) -> Tensor:
        """(Y,) int64: the rows of the vertices of the bodies (K,), concatenated."""
        count = self.count[bodies]
        begin = (self.count.cumsum(0) - self.count)[bodies]
        within = torch.arange(int(count.sum()), device=count.device)
        return within + (begin - (count.cumsum(0) - count)).repeat_interleave(count)

    def take(self, bodies: Tensor) -> Vertices:
        """The vertices of the bodies (K,)."""
        return Vertices(take_rows(self.columns, self.rows(bodies)), self.count[bodies])

    def send(self, route: Route, received: Tensor) -> Vertices:
        """Sends the vertices of the bodies on a route.

        Args:
            route: of bodies.
            received: (R,) int64: number of vertices of each received body.
        """
        sent = self.count[route.rows]
        counts = [
            [int(part.sum()) for part in torch.split(column.cpu(), bodies)]
            for column, bodies in ((sent, route.sent), (received, route.received))
        ]
        packed = pack(self.columns, self.rows(route.rows))
        return Vertices(unpack(route.neighbours.exchange(packed, *counts).wait(), self.columns), received)


def vertex_counts(meshes: MeshSet, mesh_index: Tensor) -> Tensor:
    """(N,) int64: number of vertices of bodies with these meshes (N,)."""
    begin = meshes.offsets[:, 0].to(mesh_index.device)
    return (begin[1:] - begin[:-1])[mesh_index.long()]
