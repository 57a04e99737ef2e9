"""Scenes that are hard to distribute over ranks: by where pairs meet, and by the bodies' sizes and speeds."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import torch
from torch import Tensor

import pgccd
from support.origins import recentred
from support.reports import detected
from support.shapes import bumpy, unit_quaternions


@dataclass(frozen=True)
class Crowd:
    """Bodies over one step in the box [0, 8]^3."""

    meshes: list[pgccd.Mesh]
    mesh_index: Tensor  #: (N,) int32
    position: Tensor  #: (N, 3)
    orientation: Tensor  #: (N, 4)
    velocity: Tensor  #: (N, 3)
    rotation: Tensor  #: (N, 3)
    filters: dict[str, Tensor] = field(default_factory=dict)
    min_separation: float = 0.0

    def motion(self, rows: Tensor) -> pgccd.RigidMotion:
        """Motion of some of the bodies."""
        columns = (self.position, self.orientation, self.velocity, self.rotation)
        return pgccd.RigidMotion.from_velocity(*(column[rows] for column in columns), dt=1.0)

    def scene(self, rows: Tensor) -> pgccd.Scene:
        """Some of the bodies."""
        return pgccd.Scene(self.meshes, self.mesh_index, **self.filters)[rows]

    def detect(self, report: str) -> pgccd.Contacts:
        """Contacts found by one process."""
        every_body = torch.arange(len(self.position))
        return detected(self.scene(every_body), self.motion(every_body), report, self.min_separation)


@cache
def _meshes() -> list[pgccd.Mesh]:
    rng = np.random.default_rng(5)
    return [bumpy(rng, 1), bumpy(rng, 0, size=0.4), bumpy(rng, 2, height=0.05, size=6.0)]


@cache
def _links() -> list[pgccd.Mesh]:
    """Meshes with origins outside of them, the last one's far outside."""
    return [
        recentred(mesh, joint) for mesh, joint in zip(_meshes()[:2], ([1.5, 0.0, 0.0], [0.0, 7.0, 2.0]), strict=True)
    ]


@cache
def _slender() -> list[pgccd.Mesh]:
    """A rod, a plate, a rod about one of its ends, and a body that is neither."""
    rod = pgccd.Mesh.box([3.0, 0.15, 0.1])
    return [rod, pgccd.Mesh.box([1.5, 1.5, 0.05]), recentred(rod, [1.4, 0.0, 0.0]), _meshes()[1]]


def _crowd(
    seed: int,
    position: np.ndarray,
    velocity: np.ndarray,
    mesh_index: np.ndarray | None = None,
    meshes: list[pgccd.Mesh] | None = None,
    **rest: object,
) -> Crowd:
    rng = np.random.default_rng(seed)
    count = len(position)
    index = np.zeros(count) if mesh_index is None else mesh_index
    return Crowd(
        meshes or _meshes(),
        torch.tensor(index, dtype=torch.int32),
        torch.tensor(position, dtype=torch.float64),
        torch.tensor(unit_quaternions(rng, count)),
        torch.tensor(velocity, dtype=torch.float64),
        torch.tensor(rng.normal(size=(count, 3))),
        **rest,  # type: ignore[arg-type]
    )


@cache
def crowds() -> dict[str, Crowd]:
    """Crowds by what makes them hard."""
    rng = np.random.default_rng(11)
    spread = rng.uniform(0.0, 8.0, (60, 3))
    small = np.ones(60)
    # Two bodies come from the left and from below and meet where neither started.
    third = np.array([[1.0, 6.5, 4.0], [6.5, 1.0, 4.2], [1.2, 1.2, 4.0]])
    to_third = np.array([[5.4, 0.0, 0.1], [0.0, 5.4, -0.1], [0.1, 0.2, 0.0]])
    corners = np.array([[x, y, z] for x in (2.0, 4.0, 6.0) for y in (2.0, 4.0, 6.0) for z in (3.9, 4.1)])
    flat = np.array(
        [[4.0, 4.0, -5.2]] + [[x, y, 1.4] for x in np.arange(0.5, 8.0, 1.5) for y in np.arange(0.5, 8.0, 1.5)]
    )
    down = np.zeros_like(flat)
    down[1:, 2] = -1.0
    return {
        "met in a third rank's cell": _crowd(1, third, to_third),
        "on corners of many cells": _crowd(2, corners, 0.2 * rng.normal(size=corners.shape), np.ones(len(corners))),
        "faster than cells": _crowd(3, spread, 4.0 * rng.normal(size=spread.shape), small),
        "larger than subdomains": _crowd(4, spread[:25], 0.3 * rng.normal(size=(25, 3)), np.arange(25) % 8 // 3),
        "all in one cell": _crowd(5, 0.2 + 0.2 * spread[:25], 0.3 * rng.normal(size=(25, 3)), small[:25]),
        "outside the box": _crowd(6, 3.0 * spread - 8.0, 2.0 * rng.normal(size=spread.shape)),
        "a terrain under all": _crowd(
            7,
            flat,
            down,
            np.array([2] + [1] * (len(flat) - 1)),
            filters={"static": torch.tensor([True] + [False] * (len(flat) - 1))},
        ),
        "kept apart, filtered": _crowd(
            8,
            spread,
            0.5 * rng.normal(size=spread.shape),
            small,
            filters={
                "group": torch.tensor(rng.integers(1, 8, 60)),
                "mask": torch.tensor(rng.integers(1, 8, 60)),
                "world": torch.tensor(rng.integers(0, 2, 60)),
            },
            min_separation=0.4,
        ),
        "about joints outside of them": _crowd(
            12, spread, 0.3 * rng.normal(size=spread.shape), np.arange(60) % 2, meshes=_links()
        ),
        "with margins": _crowd(
            13,
            spread,
            0.3 * rng.normal(size=spread.shape),
            np.arange(60) % 2,
            meshes=_links(),
            filters={"margin": torch.tensor(rng.uniform(0.0, 0.4, 60))},
        ),
        "rods and plates": _crowd(
            14,
            spread,
            0.5 * rng.normal(size=spread.shape),
            np.arange(60) % 4,
            meshes=_slender(),
            filters={"static": torch.arange(60) % 8 == 1, "margin": torch.tensor(rng.uniform(0.0, 0.05, 60))},
        ),
        "far from the origin": _crowd(9, 0.5 * spread + 1e7, 0.4 * rng.normal(size=spread.shape), small),
        "one body": _crowd(10, spread[:1], spread[:1]),
        "no bodies": _crowd(11, spread[:0], spread[:0]),
    }
