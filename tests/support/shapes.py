"""Random meshes and motions, seeded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd import RigidMotion


@cache
def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    g = (1 + 5**0.5) / 2
    corners = [(-1.0, g, 0.0), (1.0, g, 0.0), (-1.0, -g, 0.0), (1.0, -g, 0.0)]
    vertices = [np.roll(c, k) / np.hypot(1, g) for k in range(3) for c in corners]
    near = np.linalg.norm(np.array(vertices)[:, None] - np.array(vertices), axis=2) < 1.2
    faces = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    for _ in range(subdivisions):
        middle: dict[tuple[int, int], int] = {}
        finer = []
        for face in faces:
            halves = []
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                key = (min(a, b), max(a, b))
                if key not in middle:
                    middle[key] = len(vertices)
                    point = vertices[a] + vertices[b]
                    vertices.append(point / np.linalg.norm(point))
                halves.append(middle[key])
            (a, b, c), (ab, bc, ca) = face, halves
            finer += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = finer
    return np.array(vertices), np.array(faces, dtype=np.int64)


def bumpy(rng: np.random.Generator, subdivisions: int = 1, height: float = 0.25, size: float = 1.0) -> pgccd.Mesh:
    """A closed mesh of 20, 80, 320 ... faces: a sphere with bumps."""
    vertices, faces = icosphere(subdivisions)
    return pgccd.Mesh(size * vertices * (1 + height * rng.uniform(-1, 1, (len(vertices), 1))), faces)


def tetrahedron(size: float = 1.0) -> pgccd.Mesh:
    """A regular tetrahedron; `size` is its SBV radius."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * (size / 3**0.5)
    return pgccd.Mesh(corners, [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def height_field(rng: np.random.Generator, columns: int, rows: int, height: float = 0.3) -> pgccd.Mesh:
    """An open mesh of 2 x columns x rows faces over cells of edge 1, at random heights, facing up."""
    x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
    vertices = np.stack([x, y, height * rng.uniform(-1, 1, x.shape)], axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(rows + 1, columns + 1)
    a, b, c, d = (k.ravel() for k in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return pgccd.Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


def unit_quaternions(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 4), uniformly distributed."""
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def turned(quaternions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3), each turned by its own unit quaternion (n, 4)."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    return points + 2 * np.cross(v, np.cross(v, points) + w * points)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) unit vectors."""
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def tensors(*arrays: np.ndarray, device: torch.device | str = "cpu") -> list[Tensor]:
    """Copies of arrays as tensors."""
    return [torch.tensor(np.asarray(a), device=device) for a in arrays]


@dataclass(frozen=True)
class Bodies:
    """N bodies over a step of length 1, as arrays; body k has mesh k."""

    meshes: list[pgccd.Mesh]
    position_t0: np.ndarray
    orientation_t0: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray

    @property
    def position_t1(self) -> np.ndarray:
        """The same bits as the motion's own."""
        return self.position_t0 + self.velocity

    def scene(self, device: torch.device | str = "cpu") -> pgccd.Scene:
        """A scene with one body per mesh."""
        return pgccd.Scene(self.meshes, device=device)

    def motion(self, path: Literal["rigid", "linear"] = "rigid", device: torch.device | str = "cpu") -> RigidMotion:
        """Motion from velocities, so that any turn is possible."""
        columns = tensors(self.position_t0, self.orientation_t0, self.velocity, self.rotation, device=device)
        return RigidMotion.from_velocity(*columns, dt=1.0, path=path)


def approaching(
    rng: np.random.Generator,
    subdivisions: tuple[int, ...] = (1, 1),
    sizes: tuple[float, ...] = (1.0, 1.0),
    turn: float = 1.0,
    offset: float = 0.0,
    closeness: float = 0.9,
) -> Bodies:
    """Bodies that travel about their own size, turn by up to `turn` radians, and come near the first one.

    At some time inside the step the sphere of each overlaps that of the first: their distance is at most `closeness` of
    the sum of radii.
    """
    count = len(sizes)
    meshes = [bumpy(rng, s, size=size) for s, size in zip(subdivisions, sizes, strict=True)]
    radii = np.array([m.radius for m in meshes])
    centre = closeness * (radii[0] + radii)[:, None] * directions(rng, count) * rng.uniform(0.6, 1.0, (count, 1))
    centre[0] = 0.0
    travel = 0.7 * np.minimum(radii, radii.min() + radii)[:, None] * rng.normal(size=(count, 3))
    when = rng.uniform(0.2, 0.8, (count, 1))
    start = centre - when * travel + offset * directions(rng, 1)
    spin = turn * directions(rng, count) * rng.uniform(0.3, 1.0, (count, 1))
    return Bodies(meshes, start, unit_quaternions(rng, count), travel, spin)


def on_the_surface(rng: np.random.Generator, ratio: float, turn: float = 1.0) -> Bodies:
    """Two bodies, one `ratio` times as large as the other; inside the step the small one sits on a corner of it."""
    large, small = bumpy(rng, 1, size=ratio), bumpy(rng, 0)
    orientation = unit_quaternions(rng, 2)
    corner = turned(orientation[:1], large.vertices.numpy()[[rng.integers(len(large.vertices))]])[0]
    travel = np.concatenate([np.zeros((1, 3)), 2.0 * directions(rng, 1)])
    start = np.stack([np.zeros(3), corner]) - rng.uniform(0.2, 0.8) * travel
    spin = turn * directions(rng, 2) * np.array([[1.0 / ratio], [1.0]])
    return Bodies([large, small], start, orientation, travel, spin)
