"""Collision shapes of links as thick surfaces: triangles, and a thickness that the scene gives them as margin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgccd.geometry import shapes
from pgccd.robots.kinematics import turned

# Corners of the polygon around a cylinder, and divisions of an icosahedron around an ellipsoid.
_SECTIONS, _SUBDIVISIONS = 64, 3
# Size of the triangle at the centre of a sphere, in radii.
_POINT = 2.0**-30
#: Half the side of a plane without a size, length units.
PLANE = 1000.0


@dataclass(frozen=True)
class ThickSurface:
    """Triangles, thickened by a length.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3) int64.
        thickness: length.
        group: surfaces of a link with different groups are different bodies.
    """

    vertices: np.ndarray
    faces: np.ndarray
    thickness: float = 0.0
    group: tuple[int, ...] = ()

    def placed(self, position: np.ndarray, orientation: np.ndarray) -> ThickSurface:
        """At a position (3,), turned by a unit quaternion (4,)."""
        return replace(self, vertices=turned(orientation, self.vertices) + position)


def box(size: np.ndarray) -> ThickSurface:
    """Side lengths (3,)."""
    return ThickSurface(*shapes.box(size))


def sphere(radius: float) -> ThickSurface:
    """A point with a thickness: a triangle around it, of 10^-9 radii."""
    corners = _POINT * radius * np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    return ThickSurface(corners, np.array([[0, 1, 2]]), radius)


def capsule(radius: float, half_length: float) -> ThickSurface:
    """A segment along z with a thickness: a triangle without area."""
    if not half_length > 0.0:
        return sphere(radius)
    corners = np.array([[0.0, 0.0, -half_length], [0.0, 0.0, half_length], [0.0, 0.0, 0.0]])
    return ThickSurface(corners, np.array([[0, 1, 2]]), radius)


def cylinder(radius: float, half_length: float) -> ThickSurface:
    """A prism around the cylinder about z: it contains the cylinder, and is at most 0.13 % thicker."""
    around = radius / np.cos(np.pi / _SECTIONS)
    return ThickSurface(*shapes.cylinder(around, 2.0 * half_length, _SECTIONS))


def ellipsoid(radii: np.ndarray) -> ThickSurface:
    """A polyhedron around the ellipsoid with these half axes (3,), at most 0.8 % larger."""
    vertices, faces = shapes.sphere(1.0, _SUBDIVISIONS)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inner = float((normals * corners[:, 0]).sum(axis=1).min())
    return ThickSurface(vertices * (radii / inner), faces)


def plane(half_x: float, half_y: float) -> ThickSurface:
    """A rectangle in the plane z = 0; without a size in one direction, 2,000 length units long there."""
    x, y = half_x or PLANE, half_y or PLANE
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return ThickSurface(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def height_field(heights: np.ndarray, half_x: float, half_y: float) -> ThickSurface:
    """An open surface over a rectangle from -half_x to half_x and -half_y to half_y.

    Args:
        heights: (rows, columns), rows along y, columns along x.
    """
    rows, columns = heights.shape
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (number[i : rows - 1 + i, j : columns - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return ThickSurface(np.stack([x, y, heights], axis=2).reshape(-1, 3), faces)


def joined(surfaces: list[ThickSurface]) -> ThickSurface:
    """Surfaces of equal thickness as one."""
    first = np.cumsum([0, *(len(each.vertices) for each in surfaces[:-1])])
    faces = [each.faces + begin for each, begin in zip(surfaces, first, strict=True)]
    return ThickSurface(
        np.concatenate([each.vertices for each in surfaces]), np.concatenate(faces), surfaces[0].thickness
    )
