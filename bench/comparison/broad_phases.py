"""Broad phases on swept spheres, about one true pair per body.

Every round has its own scene; all programs find its pairs in turn, and each result is compared with the union of all.
pgccd returns the sorted pairs of spheres that meet. Other programs use boxes, or spheres around whole paths: their
excess pairs are removed by a NumPy test, whose time is listed separately. Arrays are converted to each program's own
form before timing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from support import timing
from support.scenes import MovingSpheres, random_spheres

import pgccd
from comparison import broad_phases_peers
from comparison.broad_phases_peers import FindPairs, Prepare, ReadPairs
from comparison.program import Program, row

METHODS = ("sweep", "grid", "lbvh")
# Squared distances of about 4 are computed with errors of this order; pairs closer to touching are undecided.
_ROUNDING = 1e-11


def measure(
    bodies: int,
    device: str,
    rounds: int,
    make: Callable[[int, int], MovingSpheres] = random_spheres,
    with_peers: bool = True,
) -> list[dict[str, Any]]:
    """Rows of all programs on one kind of scene; the first two rounds are warm-up."""
    programs = ours(device) | (broad_phases_peers.available(device) if with_peers else {})
    spent: dict[Program, list[float]] = {program: [] for program in programs}
    removing: dict[Program, list[float]] = {program: [] for program in programs}
    tally = {program: {"found": 0, "missed": 0, "missed_within_rounding": 0} for program in programs}
    true = 0
    for index in range(-2, rounds):
        scene = make(bodies, index + 2)
        keys: dict[Program, np.ndarray] = {}
        order = list(programs)
        for program in order[index % len(order) :] + order[: index % len(order)]:
            find = programs[program](scene)
            duration, read = timing.seconds(find, device)
            pairs = read()
            test_duration, meeting = timing.seconds(partial(scene.meet, pairs))
            keys[program] = np.sort(pairs[meeting] @ np.array([bodies, 1]))
            if index >= 0:
                tally[program]["found"] += len(pairs)
                spent[program].append(duration)
                removing[program].append(test_duration)
        if index >= 0:
            everything = np.unique(np.concatenate(list(keys.values())))
            true += len(everything)
            for program, found in keys.items():
                absent = np.setdiff1d(everything, found, assume_unique=True)
                gap = scene.gap(np.stack(np.divmod(absent, bodies), axis=1))
                tally[program]["missed"] += int((gap < -_ROUNDING).sum())
                tally[program]["missed_within_rounding"] += int((gap >= -_ROUNDING).sum())
    rows = []
    for program, numbers in tally.items():
        exact_test = {} if "exact" in program.answers else {"exact_test_ms": timing.summary(removing[program])}
        counts = {
            "true": true,
            "extra": numbers.pop("found") - true + numbers["missed"] + numbers["missed_within_rounding"],
        }
        measured = row("broad phase", program, spent[program], **counts, **numbers, **exact_test, bodies=bodies)
        rows.append(measured | {"pairs_a_body": timing.rounded(true / (bodies * rounds))})
    return rows


def ours(device: str) -> dict[Program, Prepare]:
    """pgccd's broad phases."""
    where = "GPU" if device == "cuda" else f"CPU, {torch.get_num_threads()} thread"
    return {
        Program(f"pgccd {name}", "pgccd", "exact pairs of swept spheres", device=where): _pgccd(name, device)
        for name in METHODS
    }


def _pgccd(broad_phase: str, device: str) -> Prepare:
    # Any mesh will do: only its bounding sphere is used.
    tip = 3.0**-0.5
    corners = np.array([[tip, tip, tip], [tip, -tip, -tip], [-tip, tip, -tip], [-tip, -tip, tip]])
    faces = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    find_pairs = getattr(pgccd.broad, broad_phase)

    def prepare(scene: MovingSpheres) -> FindPairs:
        count = len(scene.position_t0)
        sizes, index = np.unique(np.broadcast_to(scene.radius, count), return_inverse=True)
        meshes = pgccd.MeshSet([pgccd.Mesh(size * corners, faces, origin="centroid") for size in sizes], device)
        upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64, device=device).expand(count, 4)
        ends = [torch.from_numpy(position).to(device) for position in (scene.position_t0, scene.position_t1)]
        motion = pgccd.RigidMotion(ends[0], upright, ends[1], upright)
        bodies = pgccd.MovingBodies.of(pgccd.Scene(meshes, torch.from_numpy(index).to(device)), motion)

        def find() -> ReadPairs:
            pairs = find_pairs(bodies)
            return lambda: pairs.cpu().numpy()

        return find

    return prepare
