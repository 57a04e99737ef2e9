"""Pebbles falling on a terrain: one static mesh of very many triangles among very many small bodies."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

import pgccd
from support.random_bodies import unit_vectors

_RADIUS = 0.5  # of a pebble, in edges of the terrain's cells
_FALL = 0.2  # in radii per step
_HIGHEST = 0.5  # above the ground, in radii
_TURN = 0.1  # radians per step
_KINDS = 8
# Waves of the ground: lengths in cells, and height relative to the length.
_WAVE_LENGTHS = (400.0, 90.0, 21.0, 6.0)
_STEEPNESS = 0.02


class PebblesOnTerrain:
    """Body 0 is the terrain, with about `triangles` triangles; the rest are pebbles of 80 triangles, dropped anew in
    each step from just above the ground. Some touch the ground, and some one another.
    """

    def __init__(self, triangles: int, pebbles: int, device: torch.device | str = "cpu", seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._random = torch.Generator().manual_seed(seed)
        self._ground = Ground(random, triangles)
        terrain = self._ground.mesh()
        kind = torch.randint(1, 1 + _KINDS, (1 + pebbles,), generator=self._random)
        kind[0] = 0
        meshes = [terrain, *(pebble_mesh(random) for _ in range(_KINDS))]
        self.scene = pgccd.Scene(meshes, kind, device, static=torch.arange(1 + pebbles) == 0)
        #: Triangles of the terrain.
        self.triangle_count = len(terrain.faces)

    def motions(self) -> Iterator[pgccd.RigidMotion]:
        """Motions of successive steps, without end."""
        count = self.scene.body_count
        while True:
            place, height = (
                torch.rand((count, width), generator=self._random, dtype=torch.float64).numpy() for width in (2, 1)
            )
            place *= self._ground.cells
            ground = self._ground.height(place[:, 0], place[:, 1])
            above = _RADIUS * (1.0 + _HIGHEST * height)
            position = torch.from_numpy(np.concatenate([place, ground[:, None] + above], axis=1))
            velocity = torch.tensor([0.0, 0.0, -_FALL * _RADIUS], dtype=torch.float64).repeat(count, 1)
            orientation = unit_vectors(self._random, count, 4)
            spin = _TURN * unit_vectors(self._random, count, 3)
            position[0], velocity[0], spin[0] = 0.0, 0.0, 0.0
            orientation[0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
            columns = [column.to(self.scene.device) for column in (position, orientation, velocity, spin)]
            yield pgccd.RigidMotion.from_velocity(columns[0], columns[1], columns[2], columns[3], dt=1.0)


class Ground:
    """A height field over cells of edge 1, twice as long as wide: the sum of a few waves."""

    def __init__(self, random: np.random.Generator, triangles: int) -> None:
        width = max(1, round(math.sqrt(triangles / 4)))
        #: Cells along x and y.
        self.cells = (max(1, round(triangles / (2 * width))), width)
        self._heading = random.uniform(0.0, 2.0 * math.pi, len(_WAVE_LENGTHS))
        self._phase = random.uniform(0.0, 2.0 * math.pi, len(_WAVE_LENGTHS))

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the ground at these places."""
        total = np.zeros_like(x)
        for length, heading, phase in zip(_WAVE_LENGTHS, self._heading, self._phase, strict=True):
            along = (math.cos(heading) * x + math.sin(heading) * y) / length
            total += _STEEPNESS * length * np.sin(2.0 * math.pi * along + phase)
        return total

    def mesh(self) -> pgccd.Mesh:
        """Two triangles per cell."""
        columns, rows = self.cells
        x, y = np.meshgrid(np.arange(columns + 1.0), np.arange(rows + 1.0))
        vertices = np.stack([x, y, self.height(x, y)], axis=-1).reshape(-1, 3)
        number = np.arange(len(vertices)).reshape(rows + 1, columns + 1)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
        return pgccd.Mesh(vertices, faces.reshape(-1, 3))


def pebble_mesh(random: np.random.Generator, rings: int = 4, ring_size: int = 10) -> pgccd.Mesh:
    """A closed mesh of 42 vertices and 80 triangles: a sphere of rings, each rotated by half a vertex spacing, with
    bumps.
    """
    polar = math.pi * np.arange(1, rings + 1) / (rings + 1)
    azimuth = 2.0 * math.pi * (np.arange(ring_size) + 0.5 * np.arange(rings)[:, None]) / ring_size
    sine = np.sin(polar)[:, None]
    height = np.broadcast_to(np.cos(polar)[:, None], azimuth.shape)
    ring = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), height], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([ring, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    here = np.arange(len(ring)).reshape(rings, ring_size)
    after = np.roll(here, -1, axis=1)
    top, bottom = (np.full(ring_size, len(ring) + k) for k in (0, 1))
    faces = [
        np.stack([top, here[0], after[0]], axis=-1),
        np.stack([here[:-1], here[1:], after[:-1]], axis=-1).reshape(-1, 3),
        np.stack([after[:-1], here[1:], after[1:]], axis=-1).reshape(-1, 3),
        np.stack([bottom, after[-1], here[-1]], axis=-1),
    ]
    size = _RADIUS * (1.0 - 0.15 * random.uniform(0.0, 1.0, (len(vertices), 1)))
    return pgccd.Mesh(size * vertices, np.concatenate(faces), origin="centroid")
