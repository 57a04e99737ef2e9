"""How far a deforming scene may move along a direction before a touch: the line search of contact solvers. All programs
move vertices along straight lines; one CPU thread.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from support import frame_pairs, peers, timing
from support.near_pairs import rotate

import pgccd
from comparison.program import Program, row
from pgccd import sim

# Steps that differ by more than this fraction of the direction are counted as different.
_DIFFERENT = 1e-3

#: vertices at both ends -> function that returns the step
FindStep = Callable[[np.ndarray, np.ndarray], Callable[[], float]]


def line_search(robots: int, directions: int, device: str, seed: int = 0) -> list[dict[str, Any]]:
    """Robots as soft bodies on a lattice, initially apart: each direction is a rigid motion plus a smooth deformation
    of each. They keep a distance of a thousandth of their radius, also from themselves.
    """
    model = sim.Model(sim.ModelConfig(robots=robots, seed=seed))
    mesh, state = model.meshes.meshes[0], model.start()
    start = rotate(state.orientation, mesh.vertices) + state.position[:, None]
    distance = 1e-3 * mesh.radius
    random = torch.Generator().manual_seed(seed)
    ends = []
    for _ in range(1 + directions):
        travel, waves = (torch.randn(robots, 1, 3, generator=random, dtype=torch.float64) for _ in range(2))
        bend = 0.05 * mesh.radius * torch.sin(2.0 / mesh.radius * mesh.vertices @ waves.transpose(1, 2)) * waves
        ends.append((start + 0.3 * mesh.radius * travel + bend).reshape(-1, 3))
    scene = pgccd.Scene([mesh], torch.zeros(robots, dtype=torch.int32), device=device, self_collision=True)
    count = len(mesh.vertices)
    shift = count * torch.arange(robots, dtype=torch.int32)[:, None, None]
    edges, faces = ((rows + shift).reshape(-1, rows.shape[1]).numpy() for rows in (mesh.edges, mesh.faces))
    programs = {_ours("line search", device): _pgccd(scene, distance, device)}
    if device == "cpu":
        programs |= _ipctk(start.reshape(-1, 3).numpy(), edges, faces, distance)
    pairs = [(start.reshape(-1, 3).numpy(), end.numpy()) for end in ends]
    return _measure("line search", programs, pairs, device, robots=robots, vertices=robots * count)


def of_frames(pair: frame_pairs.FramePair, rounds: int, device: str) -> list[dict[str, Any]]:
    """The step from one frame of a public simulation to the next; and all its contacts, which only pgccd reports."""
    question = f"frame pair {pair.name}"
    scene, motion = pair.scene(device), pair.motion(device)
    spent = []
    for _ in range(1 + rounds):
        duration, hits = timing.seconds(lambda: pgccd.detect(scene, motion, "all", initial="assume_free"), device)
        spent.append(duration)
    program = Program('pgccd, report="all"', "pgccd", "toi of all touching features", device=_where(device))
    rows = [row(question, program, spent[1:], **pair.errors(hits))]
    arrays = pair.arrays
    programs = {_ours(question, device): _pgccd(scene, 0.0, device)}
    if device == "cpu":
        features = (pair.mesh.edges.numpy(), pair.mesh.faces.numpy())
        programs |= _ipctk(arrays["vertices_t0"], *features, 0.0)
    ends = [(arrays["vertices_t0"], arrays["vertices_t1"])] * (1 + rounds)
    return rows + _measure(question, programs, ends, device, vertices=len(arrays["vertices_t0"]))


def _where(device: str) -> str:
    return "GPU" if device == "cuda" else "CPU, 1 thread"


def _ours(question: str, device: str) -> Program:
    return Program('pgccd, report="earliest"', "pgccd", "certified step, and the features", device=_where(device))


def _measure(
    question: str,
    programs: dict[Program, FindStep],
    ends: list[tuple[np.ndarray, np.ndarray]],
    device: str,
    **facts: Any,
) -> list[dict[str, Any]]:
    """Rows of all programs on the same directions. The first direction is warm-up."""
    spent: dict[Program, list[float]] = {program: [] for program in programs}
    steps: dict[Program, list[float]] = {program: [] for program in programs}
    for index, (start, end) in enumerate(ends):
        for program, prepare in programs.items():
            duration, step = timing.seconds(prepare(start, end), device)
            if index:
                spent[program].append(duration)
                steps[program].append(step)
    exact = np.array(next(iter(steps.values())))
    rows = []
    for program, found in steps.items():
        beyond = np.array(found) - exact
        counts = {"longer": int((beyond > _DIFFERENT).sum()), "shorter": int((beyond < -_DIFFERENT).sum())}
        rows.append(row(question, program, spent[program], steps=len(found), **counts, **facts))
    return rows


def _pgccd(scene: pgccd.Scene, distance: float, device: str) -> FindStep:
    def prepare(start: np.ndarray, end: np.ndarray) -> Callable[[], float]:
        motion = pgccd.VertexMotion(*(torch.from_numpy(vertices).to(device) for vertices in (start, end)))

        def find() -> float:
            hits = pgccd.detect(scene, motion, "earliest", distance, initial="assume_free")
            return min(1.0, float(hits.toi[0])) if len(hits) else 1.0

        return find

    return prepare


def _ipctk(start: np.ndarray, edges: np.ndarray, faces: np.ndarray, distance: float) -> dict[Program, FindStep]:
    ipctk = peers.load_ipctk()
    if ipctk is None:
        return {}
    mesh = ipctk.CollisionMesh(np.asfortranarray(start), edges.astype(np.int32), faces.astype(np.int32))

    def prepare(method: object, start: np.ndarray, end: np.ndarray) -> Callable[[], float]:
        ends = [np.asfortranarray(vertices) for vertices in (start, end)]
        return lambda: ipctk.compute_collision_free_stepsize(mesh, *ends, distance, ipctk.LBVH(), method)

    methods = {"Tight-Inclusion": ipctk.TightInclusionCCD(), "Additive CCD": ipctk.AdditiveCCD()}
    return {
        Program(
            f"ipctk, LBVH + {name}",
            "ipctk",
            "step, shortened to keep some distance",
            "which features; contacts at the start",
        ): partial(prepare, method)
        for name, method in methods.items()
    }
