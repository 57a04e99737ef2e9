"""First toi of two near bodies of 700 triangles each, one CPU thread.

The pairs come from the standard world after it has left the lattice: bodies whose spheres meet, half of them with
meshes that stay apart and half with meshes that collide (a chosen ratio; in the world about one in twenty collides).
Every program solves every pair once, in turn, after warm-up. pgccd is timed twice: one pair per call, dominated by the
Python call, and all pairs in one call.

Programs with rigid paths are compared with pgccd's results on those; programs with straight vertex paths only, with its
results on straight paths.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from support import near_pairs, timing

import pgccd
from comparison import pairs_peers
from comparison.pairs_peers import PairsProgram
from comparison.program import Program, row
from pgccd.motion.paths import PathKind

# Tois that differ by more than this fraction of the step are counted as different.
_DIFFERENT_TOI = 1e-3
_WARM_UP = 5


def measure(free: int, colliding: int, tolerance: float, seed: int = 0) -> list[dict[str, Any]]:
    """Rows of all installed programs. `tolerance` is in SBV radii."""
    torch.set_num_threads(1)
    pairs = near_pairs.collect(free + _WARM_UP, colliding + _WARM_UP, seed)
    tolerance *= pairs.mesh.radius
    # Warm-up pairs first, then both kinds mixed.
    sorts = (torch.arange(free + _WARM_UP), free + _WARM_UP + torch.arange(colliding + _WARM_UP))
    measured = torch.cat([sort[_WARM_UP:] for sort in sorts])
    measured = measured[torch.randperm(len(measured), generator=torch.Generator().manual_seed(seed))]
    pairs = pairs[torch.cat([*(sort[:_WARM_UP] for sort in sorts), measured])]

    programs = [_pgccd(pairs, "rigid", tolerance), _pgccd(pairs, "linear", tolerance)]
    exact_of = {each.path: each.program.name for each in programs}
    programs += pairs_peers.available(pairs, tolerance)
    answers, spent = _run(programs, len(pairs))
    hit = np.isfinite(answers[exact_of["rigid"]])
    counts = {"pairs": len(hit), "triangles": len(pairs.mesh.faces)}
    rows = [_together(pairs[2 * _WARM_UP :], path, tolerance) | counts for path in ("rigid", "linear")]
    for each in programs:
        name = each.program.name
        seconds = spent[name]
        by_sort = {"free_ms": timing.summary(list(seconds[~hit])), "colliding_ms": timing.summary(list(seconds[hit]))}
        errors = _errors(answers[name], answers[exact_of[each.path]])
        rows.append(row("pairs", each.program, list(seconds), **errors, **by_sort, **counts))
    return rows


def _run(programs: list[PairsProgram], count: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Tois (inf: no collision) and seconds of all programs on all pairs except warm-up."""
    answers = {each.program.name: np.full(count, np.inf) for each in programs}
    spent = {each.program.name: np.zeros(count) for each in programs}
    for pair in range(count):
        shift = pair % len(programs)
        for each in programs[shift:] + programs[:shift]:
            name = each.program.name
            spent[name][pair], toi = timing.seconds(each.prepare(pair))
            answers[name][pair] = np.inf if toi is None else toi
    first = 2 * _WARM_UP
    found, seconds = ({name: values[first:] for name, values in columns.items()} for columns in (answers, spent))
    return found, seconds


def _pgccd(pairs: near_pairs.Pairs, path: PathKind, tolerance: float) -> PairsProgram:
    scene = pairs[:1].scene()

    def prepare(row: int) -> pairs_peers.FirstToi:
        motion = pairs[row : row + 1].motion(path)

        def first_toi() -> float | None:
            hits = pgccd.detect(scene, motion, "first", tolerance=tolerance, initial="assume_free")
            return float(hits.toi[0]) if len(hits) else None

        return first_toi

    return PairsProgram(_described(path, "one pair a call"), path, prepare)


def _together(pairs: near_pairs.Pairs, path: PathKind, tolerance: float) -> dict[str, Any]:
    """All pairs in one call; time per pair."""
    seconds: list[float] = []
    random = torch.Generator().manual_seed(0)
    for index in range(23):
        shuffled = pairs[torch.randperm(len(pairs), generator=random)]
        scene, motion = shuffled.scene(), shuffled.motion(path)
        duration, _ = timing.seconds(
            partial(pgccd.detect, scene, motion, "first", tolerance=tolerance, initial="assume_free")
        )
        if index >= 3:
            seconds.append(duration / len(pairs))
    return row("pairs", _described(path, "all pairs in one call"), seconds, missed=0, extra=0)


def _described(path: PathKind, how: str) -> Program:
    straight = ", straight paths" if path == "linear" else ""
    paths = "straight paths" if path == "linear" else "arcs"
    return Program(f"pgccd{straight}, {how}", "pgccd", f"certified toi and features; meshes on {paths}")


def _errors(toi: np.ndarray, exact: np.ndarray) -> dict[str, int]:
    """Differences from pgccd's results on the same paths. Programs without a toi return 0 or None."""
    both = np.isfinite(toi) & np.isfinite(exact)
    later = toi[both] - exact[both]
    return {
        "true": int(np.isfinite(exact).sum()),
        "missed": int((np.isfinite(exact) & ~np.isfinite(toi)).sum()),
        "extra": int((np.isfinite(toi) & ~np.isfinite(exact)).sum()),
        "earlier_toi": int((later < -_DIFFERENT_TOI).sum()),
        "later_toi": int((later > _DIFFERENT_TOI).sum()),
    }
