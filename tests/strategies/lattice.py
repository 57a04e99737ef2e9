"""Symmetric meshes that meet along lattice directions: many features touch at the same time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch

import pgccd

Surface = tuple[np.ndarray, np.ndarray]


def cube() -> Surface:
    """Vertices (8, 3) at +-1 and faces (12, 3), outward."""
    vertices = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def octahedron() -> Surface:
    """Vertices (6, 3) on the axes and faces (8, 3), outward."""
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = []
    for x, y, z in itertools.product((0, 3), (1, 4), (2, 5)):
        even = (x == 3) + (y == 4) + (z == 5)
        faces.append((x, y, z) if even % 2 == 0 else (x, z, y))
    return vertices, np.array(faces)


def subdivided(surface: Surface) -> Surface:
    """Each face split into four: the same surface, bit for bit, with more features touching at once."""
    vertices, faces = surface
    points = [tuple(v) for v in vertices.tolist()]
    number = {p: k for k, p in enumerate(points)}
    finer = []

    def middle(a: int, b: int) -> int:
        p = tuple((0.5 * (np.array(points[a]) + np.array(points[b]))).tolist())
        if p not in number:
            number[p] = len(points)
            points.append(p)
        return number[p]

    for a, b, c in faces.tolist():
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        finer += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.array(points), np.array(finer)


@dataclass(frozen=True)
class Meetings:
    """Pairs of a cube and an octahedron, each pair in its own world: bodies 2 k and 2 k + 1."""

    meshes: list[pgccd.Mesh]
    position_t0: np.ndarray  #: (2 n, 3)
    position_t1: np.ndarray
    rotation: np.ndarray  #: over the step

    @property
    def count(self) -> int:
        """Number of pairs."""
        return len(self.position_t0) // 2

    def scene(self, device: torch.device | str) -> pgccd.Scene:
        """The scene of all pairs."""
        index = torch.arange(2, dtype=torch.int32).repeat(self.count)
        world = torch.arange(self.count).repeat_interleave(2)
        return pgccd.Scene(self.meshes, index, world=world, device=device)

    def motion(self, path: str, device: torch.device | str) -> pgccd.RigidMotion | pgccd.VertexMotion:
        """Motion along `path`: rigid, linear, or vertices (without rotation)."""
        columns = [torch.from_numpy(c).to(device) for c in (self.position_t0, self.position_t1, self.rotation)]
        start, end, rotation = columns
        if path == "vertices":
            streams = [
                torch.cat([self.meshes[k % 2].vertices.to(device) + p for k, p in enumerate(x)]) for x in (start, end)
            ]
            return pgccd.VertexMotion(*streams)
        orientation = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64, device=device).repeat(2 * self.count, 1)
        return pgccd.RigidMotion.from_rotation(start, orientation, end, rotation, path=path)


def meetings(rng: np.random.Generator, count: int, subdivisions: int = 0, turning: bool = False) -> Meetings:
    """Octahedra flying at cubes at rest along directions with small integer components."""
    surfaces = [cube(), octahedron()]
    for _ in range(subdivisions):
        surfaces = [subdivided(s) for s in surfaces]
    direction = rng.integers(-7, 8, (count, 3)) / 7.0
    direction[np.abs(direction).max(axis=1) < 0.5] = (-4 / 7, 1.0, 5 / 7)
    start, end, rotation = np.zeros((3, 2 * count, 3))
    start[1::2], end[1::2] = 3.0 * direction, 0.8 * direction
    if turning:
        rotation[1::2] = 0.25 * rng.integers(-1, 2, (count, 3))
    return Meetings([pgccd.Mesh(*s) for s in surfaces], start, end, rotation)
