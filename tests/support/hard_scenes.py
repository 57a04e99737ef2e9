"""Scenes that are made to be hard: hundreds of intersections in one pair, grazing and resting contacts, equal times,
crowds that deform, bodies that turn fast about a distant axis. Others are random ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from strategies import contacts

import pgccd
from support.random_scenes import ARGUMENTS, KINDS, RandomScene, deformed, excluded, filters_of, random_scene
from support.shapes import bumpy, directions, unit_quaternions

#: How scenes are made, besides those of `random_scenes.LAYOUTS`.
HARD_LAYOUTS = ("crossing", "crowded", "grazing", "touching", "tied", "circling")
_DT = 0.7  # of `RandomScene.motion`
_CROSSING = (30, 36)
_CROWDED = (24, 32)


def hard_scene(seed: int) -> RandomScene:
    """The scene of this seed: every other one is a random one."""
    if seed % 2:
        return random_scene(seed)
    rng = np.random.default_rng([seed, 3])
    layout = HARD_LAYOUTS[seed // 2 % len(HARD_LAYOUTS)]
    made = {"crossing": _crossing, "crowded": _crowded, "tied": _tied, "circling": _circling}.get(layout)
    return _meeting(rng, seed, layout) if made is None else made(rng, seed)


def _crossing(rng: np.random.Generator, seed: int) -> RandomScene:
    """One or two pairs of bodies that nearly coincide among some 30: hundreds of edges pass through faces at t = 0."""
    count = int(rng.integers(*_CROSSING))
    meshes = [bumpy(rng, 2), bumpy(rng, 2), bumpy(rng, 0, size=0.5)]
    index = np.array([0, 1, 1, 0] + [2] * (count - 4))
    side = 2.0 * count ** (1 / 3)
    place = side * rng.uniform(-0.5, 0.5, (count, 3))
    place[1] = place[0] + rng.choice([0.0, 0.02, 0.3]) * directions(rng, 1)[0]
    if rng.integers(2):
        place[3] = place[2] + 0.1 * directions(rng, 1)[0]
    order = rng.permutation(count)
    return _scene(rng, seed, "crossing", meshes, index[order], place[order], 0.3)


def _crowded(rng: np.random.Generator, seed: int) -> RandomScene:
    """Many pairs that first meet within the step, most of them of bodies that deform."""
    count = int(rng.integers(*_CROWDED))
    meshes = [bumpy(rng, 1, height=0.05), bumpy(rng, 1)]
    place = 1.3 * count ** (1 / 3) * rng.normal(size=(count, 3))
    kind = "deforming" if rng.integers(3) else None
    return _scene(rng, seed, "crowded", meshes, rng.integers(0, 2, count), place, 1.0, kind)


def _scene(
    rng: np.random.Generator,
    seed: int,
    layout: str,
    meshes: list[pgccd.Mesh],
    index: np.ndarray,
    place: np.ndarray,
    speed: float,
    kind: str | None = None,
) -> RandomScene:
    kind = str(rng.choice(KINDS)) if kind is None else kind
    count, steps = len(index), 2 if "trajectory" in kind else 1
    filters = filters_of(rng, count, kind, 0.5)
    velocity = speed * rng.normal(size=(steps, count, 3))
    if "static" in filters:
        velocity[:, filters["static"].numpy()] = 0.0
    still = np.abs(velocity).sum(axis=(0, 2)) == 0.0
    orientation = unit_quaternions(rng, count)
    if kind in ("rigid", "linear"):
        spin = np.where(still[:, None], 0.0, rng.choice([0.0, 0.3, 2.0]) * directions(rng, count))
        poses = [place, orientation, velocity[0] / _DT, spin]
    elif kind in ("posed", "trajectory"):
        ways = np.concatenate([place[None], place + np.cumsum(velocity, axis=0)])
        turned = [np.where(still[:, None], orientation, unit_quaternions(rng, count)) for _ in ways]
        turned[0] = orientation
        poses = [ways, np.stack(turned)] if kind == "trajectory" else [ways[0], turned[0], ways[1], turned[1]]
    else:
        poses = deformed(rng, [meshes[k] for k in index], place, velocity, still, 0.05)
        poses = [poses[0][0], poses[0][1]] if kind == "deforming" else poses
    return _made(rng, seed, layout, kind, meshes, index, filters, poses)


def _made(
    rng: np.random.Generator,
    seed: int,
    layout: str,
    kind: str,
    meshes: list[pgccd.Mesh],
    index: np.ndarray,
    filters: dict[str, torch.Tensor],
    poses: list[np.ndarray],
    **arguments: Any,
) -> RandomScene:
    chosen = {name: values[rng.integers(len(values))] for name, values in ARGUMENTS.items()} | arguments
    return RandomScene(
        seed,
        layout,
        kind,
        meshes,
        torch.tensor(index, dtype=torch.int32),
        filters,
        [torch.tensor(column) for column in poses],
        chosen,
        excluded(rng, len(index)),
    )


def _meeting(rng: np.random.Generator, seed: int, layout: str) -> RandomScene:
    """Pairs that graze ("grazing") or rest ("touching") exactly at the separation, side by side or in worlds."""
    gap = float(rng.choice([0.0, 0.0, 0.125]))
    if layout == "grazing":
        turn = tuple(rng.choice([0.0, 0.3, 1.0], 2))
        pairs = [contacts.tips(rng, 3, turn, float(rng.choice([0.0, 0.5])), gap, level=2)]  # type: ignore[arg-type]
    else:
        pairs = [contacts.resting(rng, str(rng.choice(["tips", "face", "edges"])), gap) for _ in range(4)]
    meshes = [mesh for pair in pairs for mesh in pair.bodies.meshes]
    count = len(meshes)
    columns = [
        np.concatenate([getattr(pair.bodies, name) for pair in pairs])
        for name in ("position_t0", "orientation_t0", "velocity", "rotation")
    ]
    filters: dict[str, torch.Tensor] = {}
    if rng.integers(2):
        filters["world"] = torch.arange(count, dtype=torch.int32) // 2
    else:
        columns[0] = columns[0] + 8.0 * np.repeat(np.arange(count // 2), 2)[:, None]
    if gap and rng.integers(2):  # as margins
        filters["margin"] = torch.full((count,), 0.5 * gap, dtype=torch.float64)
        gap = 0.0
    poses = [columns[0], columns[1], columns[2] / _DT, columns[3] / _DT]
    return _made(rng, seed, layout, "rigid", meshes, np.arange(count), filters, poses, min_separation=gap)


def _tied(rng: np.random.Generator, seed: int) -> RandomScene:
    """Cubes in full contact, or that all meet at once: very many contacts of equal toi."""
    bodies = contacts.lattice(int(rng.integers(2, 4)))
    count = len(bodies.meshes)
    place, velocity = bodies.position_t0, np.zeros((count, 3))
    if rng.integers(2):  # layers that move onto each other
        place = place * 1.25
        velocity[:, 2] = -0.25 * place[:, 2] / 1.25 / _DT * 2.0
    filters = filters_of(rng, count, "rigid", 1.0)
    if "static" in filters:
        velocity[filters["static"].numpy()] = 0.0
    still = np.zeros((count, 3))
    kind = str(rng.choice(["rigid", "linear"]))
    poses = [place, bodies.orientation_t0, velocity, still]
    return _made(rng, seed, "tied", kind, bodies.meshes[:1], np.zeros(count), filters, poses)


def _circling(rng: np.random.Generator, seed: int) -> RandomScene:
    """Bodies on one circle far from their origins, that turn many times at different speeds: a search for first
    contacts shortens the motion to ever fewer segments.
    """
    count, far = int(rng.integers(5, 10)), float(rng.choice([5.0, 200.0]))
    made = bumpy(rng, 0)
    mesh = pgccd.Mesh(made.vertices.numpy() + [far, 0.0, 0.0], made.faces)
    angle, zero = rng.uniform(0.0, 2.0 * np.pi, count), np.zeros(count)
    turn = rng.uniform(40.0, 90.0, count) * rng.choice([-1.0, 1.0], count)
    orientation = np.column_stack([np.cos(0.5 * angle), zero, zero, np.sin(0.5 * angle)])
    place = np.column_stack([zero, zero, rng.uniform(-1.0, 1.0, count)])
    filters = filters_of(rng, count, "rigid", 0.1)
    spin = np.column_stack([zero, zero, turn])
    if "static" in filters:
        spin[filters["static"].numpy()] = 0.0
    poses = [place, orientation, np.zeros((count, 3)), spin / _DT]
    return _made(rng, seed, "circling", "rigid", [mesh], np.zeros(count, dtype=np.int64), filters, poses)
