"""What is drawn of meshes: their triangles, segments as capsules, and points as balls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pgccd.geometry import shapes
from pgccd.geometry.mesh import Mesh

# Radius of elements without a thickness, in SBV radii of their mesh.
_THIN = 0.005
# Up to so many elements in a mesh, each is drawn this finely: subdivisions of an icosahedron; sides and rings of a
# capsule's end.
_BALLS = ((100, 2), (2_000, 1), (20_000, 0))
_CAPSULES = ((100, (16, 3)), (2_000, (8, 2)))
_COARSEST_CAPSULE = 6, 1


class _Piece(NamedTuple):
    """A surface about one element, in units of its radius.

    Attributes:
        end: (M,) which end of the segment each vertex belongs to; 0 for a point.
        offset: (M, 3) from there, along two directions across the segment and along it; for a point along the axes.
        faces: (K, 3), counterclockwise seen from outside.
    """

    end: np.ndarray
    offset: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class Shape:
    """What is drawn of a mesh, made by `drawn`. Lengths are those of the mesh.

    Attributes:
        vertices: (D, 3) float64, relative to the origin: first the V of the mesh, then those around its segments, then
            those around its points.
        faces: (G, 3): first the triangles of the mesh.
        triangle_count: number of the mesh's triangles.
        vertex_count: number V of the mesh's vertices.
        thickness: distance of what is drawn from segments and points; 0 without any.
        radius: all that is drawn is within this distance of the SBV centre.
        reach: all that is drawn is within this distance of the origin.
        segments: (S, 2) rows of the mesh's vertices.
        points: (P,) rows of the mesh's vertices.
    """

    vertices: np.ndarray
    faces: np.ndarray
    triangle_count: int
    vertex_count: int
    thickness: float
    radius: float
    reach: float
    segments: np.ndarray
    points: np.ndarray

    def moved(self, positions: np.ndarray) -> np.ndarray:
        """(W, D, 3): what is drawn when the mesh's vertices are at positions (W, V, 3) one after the other. Capsules
        turn with their segments, balls are moved.
        """
        if len(self.faces) == self.triangle_count:
            return positions
        return _vertices(positions, self.segments, self.points, self.thickness)

    def corners(self, face: int) -> np.ndarray:
        """Rows of the mesh's vertices of one of its faces, or of the segments and points that follow them."""
        if face < self.triangle_count:
            return self.faces[face]
        element = face - self.triangle_count
        if element < len(self.segments):
            return self.segments[element]
        return self.points[element - len(self.segments), None]

    def some(self, count: int, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """About `count` of the segments and points, at random, in place of all; those with vertices in the rows `first`
        come first.

        Returns:
            The rows of `vertices` that are left, and faces (g, 3) of them.
        """
        kinds = ((self.segments, _capsule(len(self.segments))), (self.points[:, None], _ball(len(self.points))))
        rank = np.random.default_rng(0).permutation(len(self.segments) + len(self.points))
        ends = np.concatenate([self.segments, self.points[:, None].repeat(2, axis=1)])
        rank[np.isin(ends, first).any(axis=1)] -= len(rank)
        left = np.sort(np.argsort(rank, kind="stable")[:count])
        rows, faces, begin, here, number = [], [], self.vertex_count, 0, 0
        for elements, piece in kinds:
            size = len(piece.end)
            own = left[(left >= number) & (left < number + len(elements))] - number
            rows.append((begin + size * own[:, None] + np.arange(size)).reshape(-1))
            faces.append((here + size * np.arange(len(own))[:, None, None] + piece.faces).reshape(-1, 3))
            begin, here, number = begin + size * len(elements), here + len(rows[-1]), number + len(elements)
        return np.concatenate(rows), np.concatenate(faces)


def drawn(mesh: Mesh) -> Shape:
    """What is drawn of a mesh: its triangles as they are, each segment as a capsule and each point as a ball. Capsules
    and balls have the radius `mesh.thickness`, or a small one if that is 0. The more of them there are, the fewer
    triangles each has.

    Example:
        >>> pgccd.viz.shapes.drawn(pgccd.Mesh.sphere(0.5)).faces.shape
        (320, 3)
    """
    vertices, table = mesh.vertices.numpy(), mesh.faces.numpy()
    if mesh.triangle_count == len(table):
        none = np.zeros((0, 2), dtype=np.int64)
        count = len(vertices)
        return Shape(vertices, table, len(table), count, 0.0, mesh.radius, mesh.reach, none, none[:, 0])
    triangles, segments, points = np.split(table, np.cumsum([mesh.triangle_count, mesh.segment_count]))
    segments, points = segments[:, :2].astype(np.int64), points[:, 0].astype(np.int64)
    thickness = mesh.thickness or _THIN * mesh.radius
    faces, begin = [triangles.astype(np.int64)], len(vertices)
    for count, piece in ((len(segments), _capsule(len(segments))), (len(points), _ball(len(points)))):
        first = begin + len(piece.end) * np.arange(count)
        faces.append((first[:, None, None] + piece.faces).reshape(-1, 3))
        begin += len(piece.end) * count
    return Shape(
        _vertices(vertices[None], segments, points, thickness)[0],
        np.concatenate(faces),
        mesh.triangle_count,
        len(vertices),
        thickness,
        mesh.radius + thickness,
        mesh.reach + thickness,
        segments,
        points,
    )


def _vertices(positions: np.ndarray, segments: np.ndarray, points: np.ndarray, thickness: float) -> np.ndarray:
    """(W, D, 3) for positions (W, V, 3) of a mesh's vertices."""
    capsule, ball = _capsule(len(segments)), _ball(len(points))
    moments = len(positions)
    around_points = positions[:, points, None] + thickness * ball.offset
    around_segments = np.empty((moments, len(segments), len(capsule.end), 3))
    frame: np.ndarray | None = None
    for moment in range(moments if len(segments) else 0):
        ends = positions[moment, segments]
        frame = _frames(ends[:, 1] - ends[:, 0], frame)
        around_segments[moment] = ends[:, capsule.end] + thickness * (capsule.offset @ frame)
    parts = [around_segments.reshape(moments, -1, 3), around_points.reshape(moments, -1, 3)]
    return np.concatenate([positions, *parts], axis=1)


def _frames(along: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """(S, 3, 3): two directions across each segment and the one along it (S, 3), as rows, right-handed; turned as
    little as possible from those before, so that nothing twists.
    """
    if before is None:
        before = np.broadcast_to(np.eye(3), (len(along), 3, 3))
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0.0, along / np.where(length > 0.0, length, 1.0), before[:, 2])
    across = before[:, 0] - (before[:, 0] * along).sum(axis=1, keepdims=True) * along
    is_lost = np.linalg.norm(across, axis=1) < 0.1  # along the direction before: any other one
    other = np.eye(3)[np.abs(along).argmin(axis=1)]
    other = other - (other * along).sum(axis=1, keepdims=True) * along
    across = np.where(is_lost[:, None], other, across)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(along, across), along], axis=1)


def _ball(count: int) -> _Piece:
    """Around each of so many points: a polyhedron with its vertices on the unit sphere."""
    for most, subdivisions in _BALLS:
        if count <= most:
            offset, faces = shapes.icosphere(1.0, subdivisions)
            return _Piece(np.zeros(len(offset), dtype=np.int64), offset, faces)
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)])
    return _Piece(np.zeros(6, dtype=np.int64), corners, faces)


def _capsule(count: int) -> _Piece:
    """Around each of so many segments."""
    return _capsule_of(*next((fine for most, fine in _CAPSULES if count <= most), _COARSEST_CAPSULE))


def _capsule_of(sides: int, rings: int) -> _Piece:
    """A prism with two ends of `rings` rings, each of which closes in a point: one pole, the rings in their order along
    the segment, the other pole.
    """
    angle, here = 2.0 * np.pi * np.arange(sides) / sides, np.arange(sides)
    height = 0.5 * np.pi * np.arange(rings) / rings  # the angle above the end's plane
    height = np.concatenate([-height[::-1], height])
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    levels = [np.column_stack([np.cos(up) * ring, np.full(sides, np.sin(up))]) for up in height]
    offset = np.concatenate([[[0.0, 0.0, -1.0]], *levels, [[0.0, 0.0, 1.0]]])
    after, top = np.roll(here, -1), 1 + 2 * rings * sides
    faces = [(np.zeros(sides, dtype=np.int64), 1 + after, 1 + here)]
    for level in range(2 * rings - 1):
        low, high = 1 + level * sides, 1 + (level + 1) * sides
        faces += [(low + here, low + after, high + after), (low + here, high + after, high + here)]
    faces.append((np.full(sides, top), top - sides + here, top - sides + after))
    return _Piece(
        np.repeat([0, 1], 1 + rings * sides), offset, np.concatenate([np.stack(each, axis=1) for each in faces])
    )
