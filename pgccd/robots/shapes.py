"""Collision shapes of links as thick surfaces: triangles, segments or points, and the thickness of their meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgccd.geometry import shapes
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.solids import Solid
from pgccd.robots.kinematics import turned

# Corners of the polygon around a cylinder, and divisions of an icosahedron around an ellipsoid.
_SECTIONS, _SUBDIVISIONS = 64, 3
#: Half the side of the square in place of an infinite plane, at least; length units.
PLANE = 1e4


@dataclass(frozen=True)
class ThickSurface:
    """Triangles, segments (a, b, b) and points (a, a, a), thickened by a length.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3) int64.
        thickness: length.
        infinite: whether it is a square in place of an infinite plane, which is to be `widened`.
        group: surfaces of a link with different groups are different bodies.
        solid: whether the inside belongs to the body, as for `pgccd.Mesh`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    thickness: float = 0.0
    infinite: bool = False
    group: tuple[int, ...] = ()
    solid: Solid = "auto"

    def placed(self, position: np.ndarray, orientation: np.ndarray) -> ThickSurface:
        """At a position (3,), turned by a unit quaternion (4,)."""
        return replace(self, vertices=turned(orientation, self.vertices) + position)

    def thickened(self, thickness: float) -> ThickSurface:
        """By a length more."""
        return replace(self, thickness=self.thickness + thickness)

    def scaled(self, scale: np.ndarray) -> ThickSurface:
        """With coordinates multiplied by factors (3,), of triangles alone. Mirrored surfaces keep their outside."""
        faces = self.faces[:, ::-1] if np.prod(np.sign(scale)) < 0.0 else self.faces
        return replace(self, vertices=self.vertices * scale, faces=np.ascontiguousarray(faces))

    def mesh(self, name: str) -> Mesh:
        """The mesh, without a frame of its own.

        Raises:
            ValueError: as for `Mesh`.
        """
        mesh = Mesh._of_elements(self.vertices, self.faces, solid=self.solid, thickness=self.thickness)
        mesh.name = name
        return mesh

    def widened(self, half: float) -> ThickSurface:
        """The square in place of an infinite plane, with its half side of `PLANE` replaced by `half`."""
        return replace(self, vertices=self.centre + (self.vertices - self.centre) * (half / PLANE))

    @property
    def centre(self) -> np.ndarray:
        """(3,): the mean of the vertices."""
        return self.vertices.mean(axis=0)

    @property
    def reach(self) -> float:
        """Bound of the distance of its points from the origin."""
        return float(np.linalg.norm(self.vertices, axis=1).max()) * (1.0 + 2.0**-50) + self.thickness


def of_file(mesh: Mesh, scale: np.ndarray) -> ThickSurface:
    """The surface of a mesh file, with coordinates multiplied by factors (3,).

    Raises:
        ValueError: the file holds only points or segments, which do not bound a link.
    """
    if mesh.triangle_count < len(mesh.faces):
        raise ValueError(f"expected a file of triangles, got {mesh!r}")
    return ThickSurface(mesh.vertices.numpy(), mesh.faces.long().numpy()).scaled(scale)


def box(size: np.ndarray) -> ThickSurface:
    """Side lengths (3,)."""
    return ThickSurface(*shapes.box(size))


def sphere(radius: float) -> ThickSurface:
    """A point with a thickness."""
    return ThickSurface(np.zeros((1, 3)), np.array([[0, 0, 0]]), radius)


def capsule(radius: float, half_length: float) -> ThickSurface:
    """A segment along z with a thickness."""
    if not half_length > 0.0:
        return sphere(radius)
    return ThickSurface(np.array([[0.0, 0.0, -half_length], [0.0, 0.0, half_length]]), np.array([[0, 1, 1]]), radius)


def cylinder(radius: float, half_length: float) -> ThickSurface:
    """A prism around the cylinder about z: it contains the cylinder, and is at most 0.13 % thicker."""
    around = radius / np.cos(np.pi / _SECTIONS)
    return ThickSurface(*shapes.cylinder(around, 2.0 * half_length, _SECTIONS))


def ellipsoid(radii: np.ndarray) -> ThickSurface:
    """A polyhedron around the ellipsoid with these half axes (3,), at most 0.8 % larger."""
    vertices, faces = shapes.icosphere(1.0, _SUBDIVISIONS)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inner = float((normals * corners[:, 0]).sum(axis=1).min())
    return ThickSurface(vertices * (radii / inner), faces)


def rectangle(half_x: float, half_y: float) -> ThickSurface:
    """In the plane z = 0."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return ThickSurface(corners * [half_x, half_y, 0.0], np.array([[0, 1, 2], [0, 2, 3]]))


def infinite_plane(normal: np.ndarray | None = None) -> ThickSurface:
    """A square in the plane through the origin with a unit normal (3,), by default z."""
    z = np.array([0.0, 0.0, 1.0]) if normal is None else normal
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    square = rectangle(PLANE, PLANE)
    return replace(square, vertices=square.vertices @ np.stack([x, np.cross(z, x), z]), infinite=True)


def height_field(heights: np.ndarray, half_x: float, half_y: float, base: float) -> ThickSurface:
    """The surface of a solid from z = -base up to heights over a rectangle from -half_x to half_x and -half_y to
    half_y.

    Args:
        heights: (rows, columns), rows along y, columns along x.
    """
    rows, columns = heights.shape
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (number[i : rows - 1 + i, j : columns - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    top = np.stack([x, y, heights], axis=2).reshape(-1, 3)
    # The border, counter-clockwise seen from above, and below it the border of the base with a point in its middle.
    border = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    below = len(top) + np.arange(len(border))
    middle = np.full_like(border, len(top) + len(border))
    after, after_below = np.roll(border, -1), np.roll(below, -1)
    triangles = [(a, b, c), (a, c, d), (border, below, after_below), (border, after_below, after)]
    faces = np.concatenate([np.stack(each, axis=1) for each in [*triangles, (middle, after_below, below)]])
    bottom = np.concatenate([top[border], np.zeros((1, 3))])
    bottom[:, 2] = -base
    return ThickSurface(np.concatenate([top, bottom]), faces)


def joined(surfaces: list[ThickSurface]) -> ThickSurface:
    """Surfaces of equal thickness as one; either all or none of them are infinite planes."""
    first = np.cumsum([0, *(len(each.vertices) for each in surfaces[:-1])])
    faces = [each.faces + begin for each, begin in zip(surfaces, first, strict=True)]
    vertices = np.concatenate([each.vertices for each in surfaces])
    return replace(surfaces[0], vertices=vertices, faces=np.concatenate(faces))
