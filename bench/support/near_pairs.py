"""Pairs of nearby bodies from the standard world, in the forms that the compared programs need."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd.motion.paths import PathKind
from support.scenes import MixedWorld


@dataclass
class Pairs:
    """P pairs of bodies: columns (P, 2, ...), with the robot mesh for all."""

    mesh: pgccd.Mesh
    position: Tensor  #: (P, 2, 3) float64 at t0, relative to the middle of the pair
    orientation: Tensor  #: (P, 2, 4)
    velocity: Tensor  #: (P, 2, 3) per step
    spin: Tensor  #: (P, 2, 3) rotation vector over the step

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: Tensor | slice) -> Pairs:
        columns = (self.position, self.orientation, self.velocity, self.spin)
        return Pairs(self.mesh, *(column[rows] for column in columns))

    def motion(self, path: PathKind) -> pgccd.RigidMotion:
        """The motion of all bodies; 2 p and 2 p + 1 are pair p."""
        columns = (self.position, self.orientation, self.velocity, self.spin)
        position, orientation, velocity, spin = (column.flatten(0, 1) for column in columns)
        return pgccd.RigidMotion.from_velocity(position, orientation, velocity, spin, dt=1.0, path=path)

    def scene(self) -> pgccd.Scene:
        """The scene of all pairs, each in its own world."""
        count = len(self)
        return pgccd.Scene(
            [self.mesh],
            torch.zeros(2 * count, dtype=torch.int32),
            world=torch.arange(count).repeat_interleave(2),
        )

    def vertices(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (P, 2, V, 3) of all vertices at t0 and at t1."""
        start = rotate(self.orientation, self.mesh.vertices) + self.position[:, :, None]
        end = rotate(self.orientation_t1(), self.mesh.vertices) + (self.position + self.velocity)[:, :, None]
        return start.numpy(), end.numpy()

    def orientation_t1(self) -> Tensor:
        """Unit quaternions (P, 2, 4) at t1."""
        angle = torch.linalg.vector_norm(self.spin, dim=-1, keepdim=True)
        turn = torch.cat([torch.cos(0.5 * angle), 0.5 * torch.sinc(0.5 * angle / torch.pi) * self.spin], dim=-1)
        after = _product(turn, self.orientation)
        return after / torch.linalg.vector_norm(after, dim=-1, keepdim=True)


def collect(free: int, colliding: int, seed: int, robots: int = 4000) -> Pairs:
    """`free` pairs of the PCS (spheres that meet) with meshes that stay apart, then `colliding` pairs that collide.

    They come from successive steps of a world after it has left the lattice, at most a quarter of each from one step.
    """
    parts: dict[bool, list[Pairs]] = {False: [], True: []}
    wanted = {False: free, True: colliding}
    world = MixedWorld(robots, 40, seed=seed)
    random = torch.Generator().manual_seed(seed)
    for state in itertools.islice(world, 10_000):
        motion = world.model.motion(state)
        hits = pgccd.collide(world.scene, motion)
        met = pgccd.broad.sweep(pgccd.MovingBodies.of(world.scene, motion))
        keys = (met[:, 0] * robots + met[:, 1]).numpy()
        hit = torch.from_numpy(np.isin(keys, (hits.pairs[:, 0] * robots + hits.pairs[:, 1]).numpy()))
        for collides, part in parts.items():
            missing = wanted[collides] - sum(map(len, part))
            rows = met[hit == collides]
            take = rows[torch.randperm(len(rows), generator=random)[: min(missing, -(-wanted[collides] // 4))]]
            position = state.position[take]
            middle = position.mean(dim=1, keepdim=True)
            columns = (state.orientation[take], state.velocity[take], state.angular_velocity[take])
            part.append(Pairs(world.model.meshes.meshes[0], position - middle, *columns))
        if all(sum(map(len, part)) == wanted[collides] for collides, part in parts.items()):
            break
    every = parts[False] + parts[True]
    names = ("position", "orientation", "velocity", "spin")
    return Pairs(every[0].mesh, *(torch.cat([getattr(part, name) for part in every]) for name in names))


def rotate(quaternion: Tensor, points: Tensor) -> Tensor:
    """Points (V, 3) turned by each quaternion (..., 4): (..., V, 3)."""
    w, axis = quaternion[..., None, :1], quaternion[..., None, 1:]
    axis = axis.expand(*axis.shape[:-2], len(points), 3)
    twice = 2.0 * torch.linalg.cross(axis, points.expand_as(axis))
    return points + w * twice + torch.linalg.cross(axis, twice)


def _product(p: Tensor, q: Tensor) -> Tensor:
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    return torch.cat(
        [pw * qw - (pv * qv).sum(-1, keepdim=True), pw * qv + qw * pv + torch.linalg.cross(pv, qv)], dim=-1
    )
