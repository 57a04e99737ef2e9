"""Figure 6 of Du, Liu & Suzumura (2017): time of a step against the threshold of load balancing, with the paper's
policy.

    python bench/figure6.py                  # on this machine's GPUs, or a small version on its CPU

One cell at a time moves from the rank with most contacts to the one with fewest when they differ by more than the
threshold, relative to the most loaded. For comparison: no balancing, and pgccd's default policy.
"""

from __future__ import annotations

import argparse
from typing import Any

from support import evaluation, results
from support.evaluation import Case, Steps

# The paper's number on GPUs, a small load for them, and one that fills them.
_ROBOTS = {"cpu": [2_000], "cuda": [10_000, 1_000_000]}
_THRESHOLDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30)


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    device = arguments.device
    ranks = arguments.ranks or (min(4, evaluation.gpus()) if device == "cuda" else 4)
    steps = Steps(arguments.steps_before, arguments.steps_settling, arguments.rounds, 0)
    cases = []
    policies = [("PGCCD", 0.0), ("PGCCD, by cost", 0.0), *(("PGCCD+LB", threshold) for threshold in _THRESHOLDS)]
    for robots in arguments.robots or _ROBOTS[device]:
        for space in map(vars, evaluation.WORLDS.values()):
            cases += [Case(system, device, ranks, robots, threshold=part, **space) for system, part in policies]
    rows = evaluation.measure(cases, steps, arguments.seed)
    results.table([flat(row) for row in rows])
    results.write("figure6", device, {"ranks": ranks, "steps": vars(steps), "rows": rows}, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = evaluation.parser(__doc__)
    parser.add_argument("--robots", type=int, nargs="+", help=f"default: {_ROBOTS}")
    parser.add_argument("--ranks", type=int, help="default: 4, or the number of GPUs if there are fewer")
    return parser.parse_args()


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    return {
        "system": row["system"],
        "world": evaluation.world_of(row),
        "robots": row["robots"],
        "threshold": row["threshold"] if row["system"] == "PGCCD+LB" else None,
        "ms": row["ms"]["median"],
        "imbalance": row["imbalance"],
        "moved cells": row["moved_cells_a_step"],
    }


if __name__ == "__main__":
    main()
