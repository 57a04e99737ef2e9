"""Bodies at random places in a box, free to overlap, with a given number of potentially colliding pairs per body."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

import pgccd


class RandomBodies:
    """Bodies of random meshes; places, orientations and directions are drawn anew in every step.

    Each moves by `displacement` of its radius and turns by `turn` radians. The box is sized so that on average the
    spheres of `pairs_a_body` pairs per body meet.
    """

    def __init__(
        self,
        meshes: Sequence[pgccd.Mesh],
        bodies: int,
        pairs_a_body: float,
        device: torch.device | str = "cpu",
        displacement: float = 0.1,
        turn: float = 0.1,
        seed: int = 0,
    ) -> None:
        self._random = torch.Generator().manual_seed(seed)
        self._displacement = displacement
        self._turn = turn
        kind = torch.randint(len(meshes), (bodies,), generator=self._random)
        self.scene = pgccd.Scene(list(meshes), kind, device)
        radius = np.array([mesh.radius for mesh in meshes])
        #: Edge of the box, length units.
        self.side = box_side(bodies, radius, pairs_a_body, displacement)

    def motions(self) -> Iterator[pgccd.RigidMotion]:
        """Motions of successive steps, without end."""
        count, device = self.scene.body_count, self.scene.device
        radius = self.scene.radius[:, None]
        while True:
            place = torch.rand((count, 3), generator=self._random, dtype=torch.float64).to(device)
            orientation, direction, axis = (unit_vectors(self._random, count, width).to(device) for width in (4, 3, 3))
            velocity, spin = self._displacement * radius * direction, self._turn * axis
            yield pgccd.RigidMotion.from_velocity(self.side * (place - 0.5), orientation, velocity, spin, dt=1.0)


def scaled_copies(mesh: pgccd.Mesh, size_ratio: float, kinds: int) -> list[pgccd.Mesh]:
    """`kinds` copies of a mesh scaled by 1 / `size_ratio` to 1, uniform in their logarithm."""
    sizes = np.geomspace(1.0 / size_ratio, 1.0, kinds)
    return [pgccd.Mesh(size * mesh.vertices.numpy(), mesh.faces, origin="centroid") for size in sizes]


def box_side(bodies: int, radius: np.ndarray, pairs_a_body: float, displacement: float) -> float:
    """Edge of a box in which `pairs_a_body` pairs of spheres per body meet, with uniform places, sizes drawn from
    `radius` (K,), and displacements of `displacement` radii in random directions.
    """
    reach = np.add.outer(radius, radius)
    longer, shorter = (displacement * choose.outer(radius, radius) for choose in (np.maximum, np.minimum))
    # Mean length of the difference of two vectors in random directions.
    approach = longer + shorter**2 / (3.0 * longer)
    volume = 4.0 / 3.0 * math.pi * reach**3 + math.pi * reach**2 * approach
    side = math.inf
    for _ in range(30):
        # Fraction of a ball around a place in the box that lies inside it, to first order.
        inside = 1.0 - 1.125 * reach / side
        side = (0.5 * (bodies - 1) * float(np.mean(volume * inside)) / pairs_a_body) ** (1.0 / 3.0)
    return side


def unit_vectors(random: torch.Generator, count: int, width: int) -> Tensor:
    """Unit vectors (count, width) float64, uniform in direction; for width 4, uniform rotations."""
    vectors = torch.randn((count, width), generator=random, dtype=torch.float64)
    return vectors / torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
