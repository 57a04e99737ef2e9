"""Watertight meshes whose triangles face outwards."""

from __future__ import annotations

import numpy as np

from support.shapes import icosphere

Surface = tuple[np.ndarray, np.ndarray]


def box(lower: np.ndarray | list[float], upper: np.ndarray | list[float]) -> Surface:
    """Vertices (8, 3) and faces (12, 3)."""
    corner = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return np.where(corner, np.asarray(upper, float), np.asarray(lower, float)), np.array(faces)


def ball(subdivisions: int = 1, radius: float = 1.0) -> Surface:
    """Vertices on a sphere about 0, and 20, 80, 320 ... faces."""
    vertices, faces = icosphere(subdivisions)
    return radius * vertices, outwards(vertices, faces)


def torus(radius: float = 2.0, tube: float = 0.5, around: int = 24, across: int = 8) -> Surface:
    """A torus about the z axis."""
    a, b = np.meshgrid(2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(across) / across, indexing="ij")
    ring = radius + tube * np.cos(b)
    vertices = np.stack([ring * np.cos(a), ring * np.sin(a), tube * np.sin(b)], axis=-1).reshape(-1, 3)
    number = np.arange(around * across).reshape(around, across)
    on, up = np.roll(number, -1, axis=0), np.roll(number, -1, axis=1)
    both = np.roll(on, -1, axis=1)
    quads = np.stack([number, on, both, up], axis=-1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def voxels(filled: np.ndarray) -> Surface:
    """The surface of the unit cubes that are filled (x, y, z), two triangles a square; cubes that meet in an edge share
    it, so the mesh may be not manifold.
    """
    padded = np.pad(filled.astype(int), 1)
    squares = []
    for axis in range(3):
        step = np.diff(padded, axis=axis)
        for sense in (1, -1):
            corner = np.argwhere(step == sense) - 1
            corner[:, axis] += 1
            u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
            if sense == 1:  # the cube is beyond the square, which faces back
                u, v = v, u
            squares.append(np.stack([corner, corner + u, corner + u + v, corner + v], axis=1))
    corners = np.concatenate(squares)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    vertices, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices.astype(float), index.reshape(-1, 3)


def outwards(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces of a shape that is star-shaped about 0, turned to face outwards."""
    inward = np.linalg.det(vertices[faces]) < 0
    return np.where(inward[:, None], faces[:, ::-1], faces)


def joined(*surfaces: Surface) -> Surface:
    """One mesh of several components."""
    begin = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    return (
        np.concatenate([vertices for vertices, _ in surfaces]),
        np.concatenate([faces + first for (_, faces), first in zip(surfaces, begin, strict=False)]),
    )


def moved(surface: Surface, by: np.ndarray | list[float]) -> Surface:
    """The surface elsewhere."""
    return surface[0] + np.asarray(by, float), surface[1]


def inverted(surface: Surface) -> Surface:
    """The surface with triangles that face the other way."""
    return surface[0], surface[1][:, ::-1]
