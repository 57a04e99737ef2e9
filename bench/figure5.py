"""Figure 5 of Du, Liu & Suzumura (2017): time of a step against the number of ranks, with and without load balancing.

    python bench/figure5.py                  # on this machine's GPUs, or a small version on its CPU

The paper's 40,000 robots, and sizes at which several GPUs are worthwhile. The script starts the ranks, at most one per
GPU.
"""

from __future__ import annotations

import argparse
from typing import Any

from support import evaluation, results
from support.evaluation import Case, Steps

from pgccd import sim

_ROBOTS = {"cpu": [4_000], "cuda": [40_000, 100_000, 1_000_000, 4_000_000]}
_THRESHOLD = 0.15


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    device = arguments.device
    most = arguments.most_ranks or (min(4, evaluation.gpus()) if device == "cuda" else 4)
    steps = Steps(arguments.steps_before, arguments.steps_settling, arguments.rounds, 0)
    cases = [
        Case(system, device, ranks, robots, pattern, _THRESHOLD)
        for ranks in range(1, most + 1)
        for robots in arguments.robots or _ROBOTS[device]
        for pattern in sim.PATTERNS
        for system in ("PGCCD", "PGCCD+LB")[: 1 if ranks == 1 else 2]
    ]
    rows = evaluation.measure(cases, steps, arguments.seed)
    results.table([flat(row) for row in rows])
    results.write("figure5", device, {"steps": vars(steps), "rows": rows}, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = evaluation.parser(__doc__)
    parser.add_argument("--robots", type=int, nargs="+", help=f"default: {_ROBOTS}")
    parser.add_argument("--most-ranks", type=int, help="default: 4, or the number of GPUs if there are fewer")
    return parser.parse_args()


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    return {
        "system": row["system"],
        "world": evaluation.world_of(row),
        "robots": row["robots"],
        "ranks": row["ranks"],
        "ms": row["ms"]["median"],
        "imbalance": row["imbalance"],
        "moved cells": row["moved_cells_a_step"],
    }


if __name__ == "__main__":
    main()
