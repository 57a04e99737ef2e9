"""Which faces and edges of meshes meet."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass
class Lists:
    """A list of rows for each of n things.

    Attributes:
        begin: (n + 1,) int64: first item of each list, then the number of items.
        items: (m,) int64.
    """

    begin: Tensor
    items: Tensor

    @classmethod
    def of(cls, owner: Tensor, items: Tensor, count: int) -> Lists:
        """The lists of `count` owners, from the owner (m,) of each item (m,)."""
        ordered, order = torch.sort(owner, stable=True)
        begin = torch.searchsorted(ordered, torch.arange(count + 1, device=owner.device))
        return cls(begin, items[order])

    def to(self, device: torch.device) -> Lists:
        """A copy on another device."""
        return Lists(self.begin.to(device), self.items.to(device))

    def take(self, rows: Tensor, most: int | None = None) -> tuple[Tensor, Tensor]:
        """Of each of the rows (k,) all items, or the first `most`, one after the other: the place of their row in
        `rows` (m,), and they themselves (m,). Synchronises.
        """
        begin, length = self.begin[rows], self.begin[rows + 1] - self.begin[rows]
        length = length if most is None else length.clamp(max=most)
        place = torch.repeat_interleave(length)
        within = torch.arange(len(place), device=rows.device) - (length.cumsum(0) - length)[place]
        return place, self.items[begin[place] + within]


@dataclass
class Incidence:
    """Incidence of the meshes of a set. All indices are rows of its concatenated tensors.

    Attributes:
        faces: (F, 3) int64, vertices.
        edges: (E, 2) int64, vertices, the smaller first.
        face_edges: (F, 3) int64, edges of each face: from its first corner to the second, and so on.
        faces_of_vertex, edges_of_vertex, faces_of_edge: lists.
        outward: (meshes,) float64: 1 if the normals by the order of the corners point out of a closed mesh, -1 if they
            point into it, 0 if the mesh is open or its faces are not all wound alike.
    """

    faces: Tensor
    edges: Tensor
    face_edges: Tensor
    faces_of_vertex: Lists
    edges_of_vertex: Lists
    faces_of_edge: Lists
    outward: Tensor

    @classmethod
    def of(cls, vertices: Tensor, faces: Tensor, edges: Tensor, offsets: Tensor) -> Incidence:
        """From the first tensors of a `MeshSet`, and its offsets; all on the CPU."""
        counts = offsets[1:] - offsets[:-1]
        first_vertex = offsets[:-1, 0]
        mesh_of_face = torch.repeat_interleave(counts[:, 1])
        faces = faces.long() + first_vertex[mesh_of_face][:, None]
        edges = edges.long() + torch.repeat_interleave(first_vertex, counts[:, 2])[:, None]
        total = len(vertices)
        ends = faces.roll(-1, 1)
        low, high = torch.minimum(faces, ends), torch.maximum(faces, ends)
        face_edges = torch.searchsorted(edges[:, 0] * total + edges[:, 1], low * total + high)
        each_face = torch.arange(len(faces)).repeat_interleave(3)
        each_edge = torch.arange(len(edges)).repeat_interleave(2)

        # Closed and wound alike: two faces at each edge, one along it, one against it.
        along = torch.where(faces < ends, 1, -1).reshape(-1)
        zero = torch.zeros(len(edges), dtype=torch.int64)
        uses = zero.index_add(0, face_edges.reshape(-1), torch.ones_like(along))
        is_solid = (uses == 2) & (zero.index_add(0, face_edges.reshape(-1), along) == 0)
        mesh_of_edge = torch.repeat_interleave(counts[:, 2])
        open_edges = torch.zeros(len(counts), dtype=torch.int64).index_add(0, mesh_of_edge, (~is_solid).long())
        corners = vertices[faces] - vertices[first_vertex[mesh_of_face]][:, None]
        a, b, c = corners.unbind(1)
        volume = (a * torch.linalg.cross(b, c)).sum(1)
        volumes = torch.zeros(len(counts), dtype=torch.float64).index_add(0, mesh_of_face, volume)
        return cls(
            faces=faces,
            edges=edges,
            face_edges=face_edges,
            faces_of_vertex=Lists.of(faces.reshape(-1), each_face, total),
            edges_of_vertex=Lists.of(edges.reshape(-1), each_edge, total),
            faces_of_edge=Lists.of(face_edges.reshape(-1), each_face, len(edges)),
            outward=torch.where(open_edges == 0, torch.sign(volumes), torch.zeros_like(volumes)),
        )

    def to(self, device: torch.device) -> Incidence:
        """A copy on another device."""
        return Incidence(**{each.name: getattr(self, each.name).to(device) for each in fields(self)})
