"""Figure 6 of Du, Liu & Suzumura (2017): time of a step against the threshold of load balancing, with the paper's
policy.

    python bench/figure6.py                  # on this machine's GPUs, or a small version on its CPU

One cell at a time moves from the rank with most contacts to the one with fewest when they differ by more than the
threshold, relative to the most loaded. For comparison: no balancing, and pgccd's default policy.
"""

from __future__ import annotations

from support import evaluation, results
from support.evaluation import Case, Steps

# The paper's number on GPUs, a small load for them, and one that fills them.
_ROBOTS = {"cpu": [2_000], "cuda": [10_000, 1_000_000]}
_THRESHOLDS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30)


def main() -> None:
    """Runs the benchmark."""
    arguments = evaluation.parse_arguments(__doc__, _ROBOTS)
    device, ranks = arguments.device, arguments.ranks
    steps = Steps(arguments.steps_before, arguments.steps_settling, arguments.rounds, 0)
    cases = []
    policies = [("PGCCD", 0.0), ("PGCCD, by cost", 0.0), *(("PGCCD+LB", threshold) for threshold in _THRESHOLDS)]
    for robots in arguments.robots:
        for space in map(vars, evaluation.WORLDS.values()):
            cases += [Case(system, device, ranks, robots, threshold=part, **space) for system, part in policies]
    rows = evaluation.measure(cases, steps, arguments.seed)
    results.table([evaluation.columns(row, "threshold", "imbalance", "moved_cells_a_step") for row in rows])
    results.write("figure6", device, {"ranks": ranks, "steps": vars(steps), "rows": rows}, arguments.out)


if __name__ == "__main__":
    main()
