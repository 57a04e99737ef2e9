"""Simple closed surfaces: vertices (V, 3) float64 and faces (F, 3) int64, oriented outward."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from torch import Tensor

from pgccd import arguments

_SIZE = "a finite length > 0"
# 20 x 4^8 faces: 1.3 million.
_MOST_SUBDIVISIONS = 8
_MOST_SECTIONS = 1_000_000

Surface = tuple[np.ndarray, np.ndarray]


def box(extents: Sequence[float] | np.ndarray | Tensor) -> Surface:
    """12 triangles around the origin. See `Mesh.box`."""
    sizes = arguments.real_numbers(extents, "extents", "three lengths").double().cpu().numpy()
    if sizes.shape != (3,):
        raise ValueError(f"extents: expected three lengths, got shape {sizes.shape}")
    sizes = np.array([size(each, f"extents[{axis}]") for axis, each in enumerate(sizes.tolist())])
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    # Corner number: 4 x + 2 y + z. Each side by its corners, counterclockwise seen from outside.
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
    return corners * sizes, np.array(faces)


def icosphere(radius: float, subdivisions: int) -> Surface:
    """An icosahedron, each face divided into four `subdivisions` times. See `Mesh.icosphere`."""
    radius = size(radius, "radius")
    subdivisions = arguments.integer(subdivisions, "subdivisions", 0, f"an integer in [0, {_MOST_SUBDIVISIONS}]")
    if subdivisions > _MOST_SUBDIVISIONS:
        raise ValueError(f"subdivisions: expected an integer in [0, {_MOST_SUBDIVISIONS}], got {subdivisions}")
    golden = (1.0 + 5.0**0.5) / 2.0
    first = np.array([(0.0, y, golden * z) for y, z in product((-1.0, 1.0), repeat=2)])
    points = np.concatenate([np.roll(first, axis, axis=1) for axis in range(3)])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = _icosahedron_faces(points)
    for _ in range(subdivisions):
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        unique, middle = np.unique(edges, axis=0, return_inverse=True)
        halves = points[unique].sum(axis=1)
        ab, bc, ca = (len(points) + middle.reshape(-1, 3)).T
        a, b, c = faces.T
        points = np.concatenate([points, halves / np.linalg.norm(halves, axis=1, keepdims=True)])
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.stack([np.stack(quarter, axis=1) for quarter in quarters], axis=1).reshape(-1, 3)
    return points * radius, faces


def cylinder(radius: float, height: float, sections: int) -> Surface:
    """A prism around the z axis. See `Mesh.cylinder`."""
    radius, height = size(radius, "radius"), size(height, "height")
    expected = f"an integer in [3, {_MOST_SECTIONS}]"
    sections = arguments.integer(sections, "sections", 3, expected)
    if sections > _MOST_SECTIONS:
        raise ValueError(f"sections: expected {expected}, got {sections}")
    angle = 2.0 * np.pi * np.arange(sections) / sections
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ends = [np.column_stack([ring, np.full(sections, z)]) for z in (-0.5 * height, 0.5 * height)]
    middles = np.array([[0.0, 0.0, -0.5 * height], [0.0, 0.0, 0.5 * height]])
    here = np.arange(sections)
    after = np.roll(here, -1)
    bottom, top = np.full(sections, 2 * sections), np.full(sections, 2 * sections + 1)
    triangles = [
        (here, after, after + sections),
        (here, after + sections, here + sections),
        (bottom, after, here),
        (top, here + sections, after + sections),
    ]
    return np.concatenate([*ends, middles]), np.concatenate([np.stack(columns, axis=1) for columns in triangles])


def size(value: Any, name: str) -> float:
    """A length > 0.

    Raises:
        TypeError, ValueError: it is no such length.
    """
    length = arguments.number(value, name, _SIZE)
    if not 0.0 < length < np.inf:
        raise ValueError(f"{name}: expected {_SIZE}, got {value}")
    return length


def _icosahedron_faces(points: np.ndarray) -> np.ndarray:
    """The faces of a regular icosahedron around the origin: all triples of neighbours."""
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    near = (distance > 0.0) & (distance < 1.2)  # edges are 1.05 radii long, diagonals 1.70
    i, j, k = np.nonzero(near[:, :, None] & near[None] & near[:, None, :])
    faces = np.stack([i, j, k], axis=1)[(i < j) & (i < k)]
    a, b, c = points[faces].transpose(1, 0, 2)
    return faces[np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0.0]
