"""Which of many robots collide in a step of the standard world, after it has left the lattice."""

from __future__ import annotations

import itertools
from typing import Any, Protocol

import numpy as np
import torch
from support import timing
from support.scenes import MixedWorld

import pgccd
from comparison import bodies_peers
from comparison.program import Program, row
from pgccd import sim


class BodiesProgram(Protocol):
    """A world in a program's own data structures."""

    program: Program

    def load(self, state: sim.RobotState) -> None:
        """Sets the poses and velocities at the start of a step; not timed."""

    def find(self) -> Any:
        """Finds the collisions of the step; timed."""

    def pairs(self) -> np.ndarray | None:
        """Pairs (k, 2) found by the last call, in any order, possibly repeated; not timed. None: the program returns no
        pairs.
        """


def measure(robots: int, device: str, rounds: int, seed: int = 0) -> list[dict[str, Any]]:
    """Rows of all installed programs. pgccd's result is exact and serves as the reference."""
    world = MixedWorld(robots, 40, device, seed)
    programs: list[BodiesProgram] = [Detection(world, True, device), Detection(world, False, device)]
    programs += bodies_peers.available(world, device)
    spent: dict[str, list[float]] = {each.program.name: [] for each in programs}
    counts: dict[str, np.ndarray] = {}
    for index, state in enumerate(itertools.islice(world, 1 + rounds)):
        true = np.zeros(0, dtype=np.int64)
        for each in programs:
            each.load(state)
            duration, _ = timing.seconds(each.find, device)
            if index:
                spent[each.program.name].append(duration)
            pairs = each.pairs()
            if pairs is None:
                continue
            found = keys(pairs, robots)
            if each is programs[0]:
                true = found
            if index:
                errors = (len(true), len(np.setdiff1d(true, found)), len(np.setdiff1d(found, true)))
                counts[each.program.name] = np.array(errors) + counts.get(each.program.name, 0)
    return [
        row(
            "many bodies",
            each.program,
            spent[each.program.name],
            robots=robots,
            **dict(zip(("true", "missed", "extra"), counts.get(each.program.name, np.zeros(0)).tolist(), strict=False)),
        )
        for each in programs
    ]


def keys(pairs: np.ndarray, bodies: int) -> np.ndarray:
    """One number per pair, sorted, without duplicates."""
    return np.unique(np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1) @ np.array([bodies, 1]))


class Detection:
    """pgccd on the device of the world."""

    def __init__(self, world: MixedWorld, with_contacts: bool, device: str) -> None:
        self._world, self._call = world, pgccd.detect if with_contacts else pgccd.collide
        answers = "certified toi and features of each pair" if with_contacts else "which pairs"
        where = "GPU" if device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
        self.program = Program(f"pgccd.{self._call.__name__}", "pgccd", f"{answers}; meshes on arcs", device=where)

    def load(self, state: sim.RobotState) -> None:
        self._motion = self._world.model.motion(state)

    def find(self) -> None:
        self._hits: pgccd.Contacts | pgccd.CollidingPairs = self._call(
            self._world.scene, self._motion, initial="assume_free"
        )

    def pairs(self) -> np.ndarray:
        return self._hits.pairs.cpu().numpy()
