"""`World.step(..., resolve=True)` on ranks, and what one process finds for the same bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pgccd
from pgccd.distributed import BalanceOptions, Comm, World, WorldOptions
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from support.random_scenes import RandomScene, random_scene
from support.same_bits import difference
from support.shapes import unit_quaternions
from support.ways import body_of, world_of

Columns = dict[str, Tensor]
HALF = np.array([0.5, 0.3, 0.15])


def movable_of(scene: RandomScene) -> Tensor:
    """(N,) bool: in some scenes half of the bodies, in others all."""
    rng = np.random.default_rng(scene.seed)
    return torch.tensor(rng.uniform(size=len(scene.mesh_index)) < rng.choice([0.5, 1.0]))


def columns_of(resolved: Any, bodies_of: Callable[[Tensor], Tensor] = lambda ids: ids) -> Columns:
    """All values of a resolution, also of a trajectory, on the CPU; of bodies that are named by ids their numbers."""
    columns = {"fraction": resolved.fraction.movedim(-1, 0), "rounds": torch.tensor([resolved.rounds])}
    by = resolved.stopped_by
    columns["stopped_by"] = torch.where(by < 0, by, bodies_of(by))
    columns |= {name: bodies_of(getattr(resolved, name)) for name in ("touching_at_start", "unresolved")}
    if isinstance(resolved, pgccd.TrajectoryResolution):
        poses = {name: getattr(resolved.motion, name) for name in ("position", "orientation", "rotation")}
        columns |= {f"motion.{name}": pose.transpose(0, 1) for name, pose in poses.items() if pose is not None}
    else:
        columns |= {f"motion.{name}": column for name, column in resolved.motion.columns().items()}
    return {name: column.cpu().contiguous() for name, column in columns.items()}


def of_rank(whole: Columns, bodies: Tensor, rows: Tensor | None = None) -> Columns:
    """What a rank that owns `bodies` should have, of `columns_of` one process.

    Args:
        rows: of the columns of the motion; default: the bodies.
    """
    columns = {}
    for name, column in whole.items():
        if name in ("touching_at_start", "unresolved"):
            columns[name] = column[torch.isin(column, bodies).any(dim=1)]
        elif name.startswith("motion."):
            columns[name] = column[bodies if rows is None else rows]
        else:
            columns[name] = column if name == "rounds" else column[bodies]
    return columns


def resolve_scenes(comm: Comm, seeds: Sequence[int], device: str) -> list[tuple[Tensor, Columns, Columns]]:
    """Of each random scene the bodies of this rank, their resolution, and the contacts that come with it."""
    answers = []
    for seed in seeds:
        scene = random_scene(seed)
        world = world_of(comm, scene, device)
        own = body_of(world.id.cpu())
        resolved: Any = world.step(scene.motion(device, own), resolve=True, movable=movable_of(scene)[own])
        hits = {}
        if not isinstance(resolved, pgccd.TrajectoryResolution):
            hits = {"pairs": body_of(resolved.hits.pairs.cpu()), "toi": resolved.hits.toi.cpu()}
        answers.append((own, columns_of(resolved, body_of), hits))
    return answers


class Crowds:
    """Crowds of boxes, all in the same region, each in a world of its own: every crowd meets every border of ranks.

    Attributes:
        scene, motion: of all crowds.
        movable: (N,) bool; bodies that are not are static, or driven.
        crowd: (N,) int64.
        start, end, half_start, half_end: (N, 3) of boxes that do not turn: centres and half edges at t = 0 and 1.
        margin: (N,).
    """

    def __init__(self, seed: int, crowds: int, bodies: int, deforming: bool) -> None:
        rng = np.random.default_rng(seed)
        count = crowds * bodies
        self.crowd = np.repeat(np.arange(crowds), bodies)
        side = 1.2 * bodies ** (1 / 3)
        start = side * rng.uniform(size=(count, 3))
        velocity = rng.choice([0.3, 1.0, 2.0], size=(crowds, 1, 1)) * rng.normal(size=(crowds, bodies, 3))
        velocity = velocity.reshape(count, 3)
        kind = rng.choice(["free", "static", "driven"], size=count, p=[0.85, 0.1, 0.05])
        velocity[kind == "static"] = 0.0
        self.movable = torch.tensor(kind == "free")
        self.margin = rng.choice([0.0, 0.02, 0.1], size=count) if deforming else np.zeros(count)
        scale = rng.uniform(0.6, 1.4, size=(2, count, 3)) if deforming else np.ones((2, count, 3))
        scale[1] = np.where((kind == "static")[:, None], scale[0], scale[1])
        self.half_start, self.half_end = HALF * scale
        self.start, self.end = start, start + velocity
        self.scene = pgccd.Scene(
            [pgccd.Mesh.box(list(2.0 * HALF))],
            torch.zeros(count, dtype=torch.int32),
            world=torch.tensor(self.crowd, dtype=torch.int32),
            static=torch.tensor(kind == "static"),
            margin=torch.tensor(self.margin) if deforming else None,
        )
        self.motion: pgccd.RigidMotion | pgccd.VertexMotion
        if deforming:
            corners = self.scene.meshes.meshes[0].vertices.numpy() / HALF
            ends = [
                torch.tensor((centre[:, None] + half[:, None] * corners).reshape(-1, 3))
                for centre, half in ((self.start, self.half_start), (self.end, self.half_end))
            ]
            self.motion = pgccd.VertexMotion(*ends)
        else:
            spin = np.where((kind == "static")[:, None], 0.0, 2.0 * rng.normal(size=(count, 3)))
            columns = start, unit_quaternions(rng, count), velocity, spin
            self.motion = pgccd.RigidMotion.from_velocity(*map(torch.tensor, columns), dt=1.0)

    def gaps(self, fraction: np.ndarray, listed: set[tuple[int, int]], t: float) -> tuple[float, int]:
        """Of boxes that do not turn, at t of their shortened paths: the least distance less margins of pairs that are
        not listed; and how many pairs are near.
        """
        part = t * fraction[:, None]
        centre = self.start + part * (self.end - self.start)
        half = self.half_start + part * (self.half_end - self.half_start)
        bodies = int((self.crowd == 0).sum())
        i, j = np.triu_indices(bodies, 1)
        first = np.arange(0, len(centre), bodies)[:, None]
        i, j = (first + i).reshape(-1), (first + j).reshape(-1)
        between = np.maximum(np.abs(centre[i] - centre[j]) - half[i] - half[j], 0.0)
        gap = np.linalg.norm(between, axis=1) - self.margin[i] - self.margin[j]
        static = self.scene.static.numpy().astype(bool)
        gap[static[i] & static[j]] = np.inf  # such pairs are not tested
        gap[self._inside(i, j) | self._inside(j, i)] = np.inf  # their surfaces have no common point
        near = int((gap < 0.1).sum())
        for row in np.nonzero(gap < 1e-12)[0]:
            if (int(i[row]), int(j[row])) in listed:
                gap[row] = np.inf
        return float(gap.min()), near

    def _inside(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Whether boxes i begin inside boxes j."""
        space = self.half_start[j] - self.half_start[i] - self.margin[[i, j]].sum(axis=0)[:, None]
        return (np.abs(self.start[i] - self.start[j]) <= space).all(axis=1)


def resolve_crowds(comm: Comm, seed: int, crowds: int, bodies: int, deforming: bool) -> tuple[Tensor, Columns]:
    """The bodies of this rank, and their resolution."""
    made = Crowds(seed, crowds, bodies, deforming)
    scene, motion, mesh_index = made.scene, made.motion, made.scene.mesh_index
    start = torch.tensor(made.start)
    mine = torch.arange(comm.rank, len(start), comm.size).flip(0)
    partition = "cells" if seed % 2 else "bisection"
    world = World.create(
        scene[mine],
        start[mine],
        (0.0,) * 3,
        tuple(start.amax(dim=0).tolist()),
        id=mine,
        payload={"movable": made.movable[mine]},
        comm=comm,
        options=WorldOptions(balance=BalanceOptions("none"), partition=partition),
    )
    own = world.id
    if isinstance(motion, pgccd.VertexMotion):
        counts = vertex_counts(scene.meshes, mesh_index)
        vertices = Vertices(motion.columns(), counts).take(own).columns
        resolved: Any = world.step(
            pgccd.VertexMotion(vertices["x_t0"], vertices["x_t1"]), resolve=True, movable=world.payload["movable"]
        )
    else:
        resolved = world.step(motion[own], resolve=True, movable=world.payload["movable"])
    return own, columns_of(resolved)


def require_equal(answers: Sequence[tuple[Tensor, Columns]], whole: Columns, vertices: int = 0) -> None:
    """Asserts that each rank has what one process found.

    Args:
        vertices: of each body, if they deform.
    """
    assert torch.cat([own for own, _ in answers]).sort().values.equal(torch.arange(len(whole["fraction"])))
    for rank, (own, found) in enumerate(answers):
        rows = (vertices * own[:, None] + torch.arange(vertices)).reshape(-1) if vertices else None
        said = difference(found, of_rank(whole, own, rows))
        assert said is None, f"rank {rank} of {len(answers)}: {said}"
