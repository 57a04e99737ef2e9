"""Contacts and what surrounds them: corners of features, the surfaces around them, and how these move."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.contacts.contacts import Contacts
from pgccd.contacts.kinds import EDGE, FACE, FEATURES, VERTEX, Kind
from pgccd.geometry.incidence import Incidence, Lists
from pgccd.geometry.mesh import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.vectors import cross, dot, norm

# Coordinates of a point on the border of a feature may differ from 0 and 1 by so much, which is rounding.
_ROUNDED = 2.0**-46
# Offsets below this part of the size of what was subtracted may be rounding.
_NOISE = 2.0**-36


def reduced(values: Tensor, owner: Tensor, count: int, how: str, without: float) -> Tensor:
    """(count,) largest ("amax") or smallest ("amin") of the values (m,) of each owner (m,); `without` any: that."""
    start = torch.full((count,), without, dtype=values.dtype, device=values.device)
    return start.scatter_reduce(0, owner, values, how)


def groups_of(*columns: Tensor) -> tuple[Tensor, Tensor]:
    """Of rows (K, ...) of columns of 64 bits those that are equal to the bit: the group of each (K,), and the first row
    of each group (G,).
    """
    bits = [column.reshape(len(column), -1).contiguous().view(torch.int64) for column in columns]
    distinct, group = torch.unique(torch.cat(bits, 1), dim=0, return_inverse=True)
    every = torch.arange(len(group), device=group.device)
    return group, reduced(every, group, len(distinct), "amin", len(group))


def feature_rows(meshes: MeshSet, mesh: Tensor, kind: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
    """Of contacts of meshes (K, 2): VERTEX, FACE or EDGE (K, 2), and the row (K, 2) among these of all meshes."""
    what = torch.tensor(FEATURES, device=kind.device)[kind.long()]
    return what, meshes.offsets.to(kind.device)[mesh, what] + features.long()


def corner_rows(meshes: MeshSet, mesh: Tensor, what: Tensor, row: Tensor) -> Tensor:
    """(K, 2, 3) int64: the corners of features of meshes (K, 2), see `Corners`, as rows of the vertices of all meshes.

    Args:
        what, row: see `feature_rows`.
    """
    _, faces, edges, *_ = meshes.tensors  # vertices of their mesh
    of_face = faces[torch.where(what == FACE, row, 0)]
    of_edge = edges[torch.where(what == EDGE, row, 0)][:, [[0], [1]], [[0, 1, 0], [0, 0, 1]]]
    what, first = what[:, :, None], meshes.offsets[:, 0].to(mesh.device)[mesh][:, :, None]
    return torch.where(what == VERTEX, row[:, :, None], first + torch.where(what == FACE, of_face, of_edge))


def on_cpu(scene: Scene, motion: RigidMotion | VertexMotion) -> tuple[Scene, RigidMotion | VertexMotion]:
    """The scene and the motion on the CPU: themselves, or copies. The meshes are copied once."""
    if scene.device.type != "cpu":
        meshes = scene.meshes._on_cpu
        scene, motion = scene.to("cpu"), motion.to("cpu")
        scene.meshes = meshes
    return scene, motion


@dataclass
class Sites:
    """K contacts of bodies on their paths. Vertices, faces and edges are rows of the meshes' concatenated tensors.

    Points of a body are relative to its reference: the body's origin, or of a deforming body the contact's point.

    Args:
        scene: of the bodies.
        motion: of the same bodies.
        bodies: (K, 2) int64, rows of the motion.
        kind, features, coordinates, toi, point: columns of the contacts.
    """

    scene: Scene
    motion: RigidMotion | VertexMotion
    bodies: Tensor
    kind: Tensor
    features: Tensor
    coordinates: Tensor
    toi: Tensor
    point: Tensor

    def __post_init__(self) -> None:
        meshes = self.scene.meshes
        self.mesh = self.scene.mesh_index[self.bodies].long()
        #: (K, 2): what each feature is, and its row
        self.counted, self.feature = feature_rows(meshes, self.mesh, self.kind, self.features)
        self.first_vertex = meshes.offsets[:, 0].to(self.kind.device)[self.mesh]
        motion = self.motion
        if isinstance(motion, RigidMotion):
            # (K, 2, 4) unit quaternions
            self.orientation = self._orientation(self.toi)
            self.orientation_t0 = self._orientation(torch.zeros_like(self.toi))
            self.orientation_t1 = self._orientation(torch.ones_like(self.toi)) if motion.path == "linear" else None

    @classmethod
    def of(cls, contacts: Contacts, scene: Scene, motion: RigidMotion | VertexMotion, bodies: Tensor) -> Sites:
        """Of contacts of bodies (K, 2), on the CPU: on a GPU decisions near rounding could be others. Synchronises with
        a GPU, and copies the scene and the motion from there.
        """
        scene, motion = on_cpu(scene, motion)
        columns = (contacts.kind, contacts.features, contacts.coordinates, contacts.toi, contacts.point)
        return cls(scene, motion, bodies.cpu(), *(column.detach().cpu() for column in columns))

    def __getitem__(self, rows: Tensor | slice) -> Sites:
        """Some of the contacts: a mask (K,), row numbers or a slice."""
        columns = (self.bodies, self.kind, self.features, self.coordinates, self.toi, self.point)
        return Sites(self.scene, self.motion, *(column[rows] for column in columns))

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def incidence(self) -> Incidence:
        return self.scene.meshes._incidence

    @functools.cached_property
    def turns(self) -> Tensor:
        """(K,) bool: a body of the contact turns, on an arc."""
        if isinstance(self.motion, VertexMotion) or self.orientation_t1 is not None:
            return torch.zeros_like(self.toi, dtype=torch.bool)
        return (self.motion.rotation.detach()[self.bodies] != 0.0).any(2).any(1)

    def _orientation(self, time: Tensor) -> Tensor:
        """(K, 2, 4): unit quaternions at times (K,)."""
        assert isinstance(self.motion, RigidMotion)
        m, body = self.motion, self.bodies.reshape(-1)
        columns = (m.position_t0, m.position_t1, m.orientation_t0, m.rotation)
        rows = (column.detach()[body].contiguous() for column in columns)
        x0, x1, q0, rotation = rows
        _, orientation = ops.poses_at(x0, x1, q0, rotation, time.repeat_interleave(2).contiguous())
        return orientation.view(-1, 2, 4)

    def arms(self, side: int, owner: Tensor, vertex: Tensor) -> Tensor:
        """(m, 3): vertices (m,) of the bodies of one side of contacts `owner` (m,) at their toi, relative to the
        reference of the body. The same bits on every device.
        """
        toi = self.toi[owner][:, None]
        if isinstance(self.motion, VertexMotion):
            x0, x1 = self.ends(side, owner, vertex)
            return x0 + toi * (x1 - x0)
        if self.orientation_t1 is None:
            return _oriented(self.scene.meshes.tensors[0][vertex], self.orientation[:, side][owner])
        x0, x1 = self.ends(side, owner, vertex)
        return x0 + toi * (x1 - x0)

    def ends(self, side: int, owner: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor]:
        """As `arms`, at both ends of the step; on arcs both are those at t = 0."""
        body = self.bodies[:, side]
        if isinstance(self.motion, VertexMotion):
            row = (self.scene.layout.vertex_begin[body] - self.first_vertex[:, side])[owner] + vertex
            point = self.point[owner]
            return self.motion.x_t0.detach()[row] - point, self.motion.x_t1.detach()[row] - point
        vertices = self.scene.meshes.tensors[0][vertex]
        start = _oriented(vertices, self.orientation_t0[:, side][owner])
        if self.orientation_t1 is None:
            return start, start
        return start, _oriented(vertices, self.orientation_t1[:, side][owner])

    def nearest(self, side: int) -> Tensor:
        """(K, 3): the nearest point of the feature of one side, as `arms`."""
        return self._of_nearest(side, self.arms)

    def velocity(self) -> Tensor:
        """(K, 3): of the nearest point of j relative to that of i, both fixed to their features, at toi, per step."""
        return (self._of_nearest(1, self._rates) - self._of_nearest(0, self._rates)) + self.travel()[1]

    def _rates(self, side: int, owner: Tensor, vertex: Tensor) -> Tensor:
        """As `arms`, how they change, per step."""
        if isinstance(self.motion, RigidMotion) and self.orientation_t1 is None:
            rotation = self.motion.rotation.detach()[self.bodies[:, side]][owner]
            return cross(rotation, self.arms(side, owner, vertex))
        x0, x1 = self.ends(side, owner, vertex)
        return x1 - x0

    def _of_nearest(self, side: int, of_vertices: Callable[[int, Tensor, Tensor], Tensor]) -> Tensor:
        """(K, 3): of the nearest point of one side what `of_vertices` gives of its corners."""
        u, v = self.coordinates.unbind(1)
        every = torch.arange(len(self), device=u.device)
        kind, corners = self.counted[:, side], self.corners(side)
        at = [of_vertices(side, every, corner) for corner in corners.unbind(1)]
        on_face = at[0] + (u[:, None] * (at[1] - at[0]) + v[:, None] * (at[2] - at[0]))
        on_edge = at[0] + self._part_of_edge(side)[:, None] * (at[1 + side] - at[0])
        return torch.where((kind == FACE)[:, None], on_face, torch.where((kind == EDGE)[:, None], on_edge, at[0]))

    def _part_of_edge(self, side: int) -> Tensor:
        """(K,): where on an edge of one side the nearest point is, from 0 at its first vertex to 1 at its second."""
        part = self.coordinates[:, side]
        # The coordinates of an edge that passes through a face are those of the point in the face.
        rows = torch.nonzero(self.kind == (Kind.EF_AB, Kind.EF_BA)[side])[:, 0]
        if len(rows) == 0:
            return part
        first, second = self.corners(side)[rows][:, [0, 1 + side]].unbind(1)
        start = self.arms(side, rows, first)
        along = self.arms(side, rows, second) - start
        square = dot(along, along)
        of_point = dot(self._arm_of_point(side)[rows] - start, along) / torch.where(square > 0.0, square, 1.0)
        return part.index_put((rows,), of_point.clamp(0.0, 1.0))

    def _arm_of_point(self, side: int) -> Tensor:
        """(K, 3): from the reference of the body of one side at toi to the contact's point."""
        if isinstance(self.motion, VertexMotion):
            return torch.zeros_like(self.point)
        body = self.bodies[:, side]
        start = self.motion.position_t0.detach()[body]
        change = self.motion.position_t1.detach()[body] - start
        return self.point - (start + self.toi[:, None] * change)

    def corners(self, side: int) -> Tensor:
        """(K, 3): vertices of the features of one side, see `corner_rows`."""
        return self._corners[:, side]

    @functools.cached_property
    def _corners(self) -> Tensor:
        return corner_rows(self.scene.meshes, self.mesh, self.counted, self.feature)

    def supports(self, side: int) -> tuple[Tensor, Tensor]:
        """What of the surface of one side the nearest point lies on: VERTEX, FACE or EDGE (K,), and its row (K,)."""
        u, v = self.coordinates.unbind(1)
        kind, feature = self.counted[:, side], self.feature[:, side]
        corners = self.corners(side)
        at = u if side == 0 else v
        is_edge, is_face = kind == EDGE, kind == FACE
        low_u, low_v, high = u <= _ROUNDED, v <= _ROUNDED, u + v >= 1.0 - _ROUNDED
        borders = low_u.long() + low_v.long() + high.long()
        # Edges of a face: 0 from the first corner (v = 0), 1 opposite of it, 2 back to it (u = 0).
        which = torch.where(low_v, 0, torch.where(high, 1, 2))
        of_face = self.incidence.face_edges[torch.where(is_face, feature, 0)].gather(1, which[:, None])[:, 0]
        corner = torch.where(low_u & low_v, 0, torch.where(low_v, 1, 2))
        corner = torch.where(is_edge, (1 + side) * (at > 0.5).long(), corner)
        at_corner = torch.where(is_edge, (at <= _ROUNDED) | (at >= 1.0 - _ROUNDED), borders >= 2)
        on_edge = torch.where(is_face, borders == 1, is_edge) & ~at_corner
        is_vertex = (kind == VERTEX) | at_corner
        vertex = corners.gather(1, corner[:, None])[:, 0]
        what = torch.where(is_vertex, VERTEX, torch.where(on_edge, EDGE, FACE))
        row = torch.where(is_vertex, vertex, torch.where(on_edge & is_face, of_face, feature))
        return what, row

    def faces_around(self, what: Tensor, row: Tensor, most: int | None = None) -> tuple[Tensor, Tensor]:
        """Faces at vertices, edges or faces (n,), the first `most` of each: the place of each in these (m,), ascending
        within each kind, and the face (m,). Synchronises.
        """
        owners, faces = [], []
        for each, of in self._lists:
            chosen = torch.nonzero(what == each)[:, 0]
            place, items = of.take(row[chosen], most)
            owners.append(chosen[place])
            faces.append(items)
        chosen = torch.nonzero(what == FACE)[:, 0]
        return torch.cat([*owners, chosen]), torch.cat([*faces, row[chosen]])

    def face_counts(self, what: Tensor, row: Tensor) -> Tensor:
        """(n,): how many faces `faces_around` gives of each."""
        count = (what == FACE).long()
        for each, of in self._lists:
            rows = torch.where(what == each, row, 0)
            count = torch.where(what == each, of.begin[rows + 1] - of.begin[rows], count)
        return count

    @property
    def _lists(self) -> tuple[tuple[int, Lists], ...]:
        return (VERTEX, self.incidence.faces_of_vertex), (EDGE, self.incidence.faces_of_edge)

    def offset(self) -> tuple[Tensor, Tensor]:
        """From the nearest point of i to that of j at toi (K, 3), and a length below which it may be rounding (K,)."""
        apart = self.nearest(1) - self.nearest(0)
        every = torch.arange(len(self), device=apart.device)
        size = torch.zeros_like(self.toi)
        for side in (0, 1):
            for corner in self.corners(side).unbind(1):
                start, end = self.ends(side, every, corner)
                size = torch.maximum(size, norm(start) + norm(end - start))
        between, change = self.travel()
        if isinstance(self.motion, RigidMotion):
            apart = apart + (between + self.toi[:, None] * change)
        return apart, _NOISE * (size + norm(between) + norm(change))

    def point_error(self) -> tuple[Tensor, Tensor]:
        """How far the contacts' points are from halfway between the nearest points of the features at toi (K,); and the
        sizes that were added for that (K,).
        """
        arms = [self.nearest(side) - self._arm_of_point(side) for side in (0, 1)]
        away = norm(0.5 * (arms[0] + arms[1]))
        _, noise = self.offset()
        return away, noise / _NOISE + norm(self.point)

    def is_reversed(self, normal: Tensor) -> Tensor:
        """(K,) bool: contacts with toi > 0 that coincide up to rounding, whose normal (K, 3), though, says that they
        recede: they were apart before, on the other side.
        """
        offset, noise = self.offset()
        return (norm(offset) <= noise) & (self.toi > 0.0) & (dot(normal, self.velocity()) > 0.0)

    def travel(self) -> tuple[Tensor, Tensor]:
        """From the reference of i to that of j at t = 0 (K, 3), and by how much that changes over the step (K, 3)."""
        if isinstance(self.motion, VertexMotion):
            zero = torch.zeros_like(self.point)
            return zero, zero
        start = self.motion.position_t0.detach()[self.bodies]
        change = self.motion.position_t1.detach()[self.bodies] - start
        return start[:, 1] - start[:, 0], change[:, 1] - change[:, 0]


def _oriented(vectors: Tensor, orientation: Tensor) -> Tensor:
    """Vectors (m, 3) from body to world, by unit quaternions (m, 4)."""
    scalar, vector = orientation[:, :1], orientation[:, 1:]
    twice = 2.0 * cross(vector, vectors)
    return vectors + scalar * twice + cross(vector, twice)
