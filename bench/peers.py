"""pgccd compared with other programs, on the same scenes in the same process.

    python bench/peers.py                   # on a CPU
    python bench/peers.py --device cuda     # programs that run on a GPU
    python bench/peers.py --questions pairs broad-phase

Five questions: the first toi of two near bodies; which of many bodies collide in a step; which swept spheres meet (the
broad phase); how far a deforming scene may move (line search); and the step from one frame of public simulations to the
next (with --data, a folder that holds scenes/). Every row gives the program and its version, its kind of result, the
parts of the question it cannot answer, and the numbers of true results missed and of false ones. Surfaces that
intersect at the start, which the others do not look for, are not looked for here (initial="assume_free"). Programs that
are not installed are skipped: pip install -r bench/requirements-peers.txt.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from comparison import bodies, broad_phases, pairs, steps
from support import frame_pairs, results

_BODIES = {"cpu": 1_000, "cuda": 10_000}
_SPHERES = {"cpu": 100_000, "cuda": 1_000_000}


def main() -> None:
    """Runs the benchmark."""
    parser = results.parser(__doc__)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--questions", nargs="+", choices=list(_QUESTIONS), default=list(_QUESTIONS))
    parser.add_argument("--data", type=Path, help="folder with scenes/, for frame pairs")
    parser.add_argument("--pairs", type=int, default=200, help="free ones, and as many colliding ones")
    parser.add_argument("--bodies", type=int, help=f"default: {_BODIES}")
    parser.add_argument("--spheres", type=int, help=f"default: {_SPHERES}")
    parser.add_argument("--rounds", type=int, default=8, help="steps, scenes or directions timed")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    threads = torch.get_num_threads()
    for name in arguments.questions:
        # Many bodies use all threads; otherwise one thread, because some programs have only one.
        torch.set_num_threads(threads if name == "bodies" else 1)
        found = _QUESTIONS[name](arguments)
        rows += found
        print()
        results.table([flat(row) for row in found])
    torch.set_num_threads(threads)
    results.write("peers", arguments.device, {"rows": rows}, arguments.out)


def _pairs(arguments: Any) -> list[dict[str, Any]]:
    # One pair is too little work for a GPU.
    return [] if arguments.device == "cuda" else pairs.measure(arguments.pairs, arguments.pairs, 1e-6, arguments.seed)


def _bodies(arguments: Any) -> list[dict[str, Any]]:
    count = arguments.bodies or _BODIES[arguments.device]
    return bodies.measure(count, arguments.device, arguments.rounds, arguments.seed)


def _broad_phase(arguments: Any) -> list[dict[str, Any]]:
    count = arguments.spheres or _SPHERES[arguments.device]
    return broad_phases.measure(count, arguments.device, arguments.rounds)


def _line_search(arguments: Any) -> list[dict[str, Any]]:
    return steps.line_search(50, arguments.rounds, arguments.device, arguments.seed)


def _frame_pairs(arguments: Any) -> list[dict[str, Any]]:
    if arguments.data is None:
        print("no --data: frame pairs are left out")
        return []
    found = frame_pairs.load(arguments.data)
    return [row for pair in found for row in steps.of_frames(pair, min(3, arguments.rounds), arguments.device)]


_QUESTIONS: dict[str, Callable[[Any], list[dict[str, Any]]]] = {
    "pairs": _pairs,
    "bodies": _bodies,
    "broad-phase": _broad_phase,
    "line-search": _line_search,
    "frame-pairs": _frame_pairs,
}


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    counts = ("true", "missed", "extra", "earlier_toi", "later_toi", "longer", "shorter")
    head = {key: row[key] for key in ("question", "program", "version", "device")}
    return head | {"ms": row["ms"]["median"]} | {key: row.get(key) for key in counts}


if __name__ == "__main__":
    main()
