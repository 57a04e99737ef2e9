"""Figure 4 of Du, Liu & Suzumura (2017): speedup of a step over PCCCD, with and without load balancing.

    python bench/figure4.py                  # on this machine's GPUs, or a small version on its CPU
    python bench/figure4.py --device cpu --robots 10000 20000

The script starts the ranks: four, or one per GPU if there are fewer GPUs. The simulation is timed by whole steps
(detection, resolution of collisions, migration, balance); PCCCD only by its detection of the same motions, on all cores
of the machine: on as many ranks, or on more with fewer threads each, whichever is fastest. All must find the same
contacts.
"""

from __future__ import annotations

import math
import os
from typing import Any

from support import evaluation, results
from support.evaluation import Case, Steps

from pgccd import sim

_ROBOTS = {"cpu": [1_000, 3_000, 8_000], "cuda": [10_000, 20_000, 30_000, 40_000]}
_THRESHOLD = 0.15  # as in the paper


def main() -> None:
    """Runs the benchmark."""
    arguments = evaluation.parse_arguments(__doc__, _ROBOTS)
    device, ranks = arguments.device, arguments.ranks
    steps = Steps(arguments.steps_before, arguments.steps_settling, arguments.rounds, arguments.baseline_rounds)
    cases = []
    for robots in arguments.robots:
        for split in baseline_ranks(ranks):
            cases += [Case("PCCCD", "cpu", split, robots, pattern) for pattern in sim.PATTERNS]
        for system in ("PGCCD", "PGCCD+LB"):
            spaces = map(vars, evaluation.WORLDS.values())
            cases += [Case(system, device, ranks, robots, threshold=_THRESHOLD, **space) for space in spaces]
    rows = with_speedups(evaluation.measure(cases, steps, arguments.seed))
    results.table([evaluation.columns(row, "speedup", "imbalance", "contacts") for row in rows])
    results.write("figure4", device, {"ranks": ranks, "steps": vars(steps), "rows": rows}, arguments.out)


def baseline_ranks(ranks: int) -> list[int]:
    """Numbers of ranks for PCCCD on all cores: more ranks bisect in parallel, but send more."""
    cores = len(os.sched_getaffinity(0))
    return sorted({ranks, max(ranks, cores // 4), max(ranks, cores)})


def with_speedups(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds each row's speedup over PCCCD in the same world, on PCCCD's best number of ranks."""
    base: dict[tuple[int, str], float] = {}
    for row in rows:
        if row["system"] == "PCCCD":
            world = (row["robots"], row["pattern"])
            base[world] = min(row["ms"]["median"], base.get(world, math.inf))
    rows = [row | {"speedup": base[row["robots"], row["pattern"]] / row["ms"]["median"]} for row in rows]
    order = ("pattern", "axes", "stretch", "robots", "system", "ranks")
    return sorted(rows, key=lambda row: [row[key] for key in order])


if __name__ == "__main__":
    main()
