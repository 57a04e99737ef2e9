"""Figure 5 of Du, Liu & Suzumura (2017): time of a step against the number of ranks, with and without load balancing.

    python bench/figure5.py                  # on this machine's GPUs, or a small version on its CPU

The paper's 40,000 robots, and sizes at which several GPUs are worthwhile. The script starts the ranks, at most one per
GPU.
"""

from __future__ import annotations

from support import evaluation, results
from support.evaluation import Case, Steps

from pgccd import sim

_ROBOTS = {"cpu": [4_000], "cuda": [40_000, 100_000, 1_000_000, 4_000_000]}
_THRESHOLD = 0.15


def main() -> None:
    """Runs the benchmark."""
    arguments = evaluation.parse_arguments(__doc__, _ROBOTS)
    device = arguments.device
    steps = Steps(arguments.steps_before, arguments.steps_settling, arguments.rounds, 0)
    cases = [
        Case(system, device, ranks, robots, pattern, _THRESHOLD)
        for ranks in range(1, arguments.ranks + 1)
        for robots in arguments.robots
        for pattern in sim.PATTERNS
        for system in ("PGCCD", "PGCCD+LB")[: 1 if ranks == 1 else 2]
    ]
    rows = evaluation.measure(cases, steps, arguments.seed)
    results.table([evaluation.columns(row, "imbalance", "moved_cells_a_step") for row in rows])
    results.write("figure5", device, {"steps": vars(steps), "rows": rows}, arguments.out)


if __name__ == "__main__":
    main()
