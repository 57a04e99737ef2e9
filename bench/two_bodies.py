"""The time of one call of `pgccd.detect`: the first contact of two near robots of 700 triangles, on the CPU.

    python bench/two_bodies.py [--pairs N] [--rounds N] [--threads N]

The pairs come from the standard world: bodies with overlapping spheres, half of them with meshes that stay apart, half
with meshes that collide. Each pair is a separate scene; the pairs are called in turn, so that inputs vary. For
comparison: the operators that the call runs, recorded once and called again with the same arguments, and a trivial
torch operator.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from support import near_pairs, results, timing
from torch.utils._python_dispatch import TorchDispatchMode

import pgccd

_WARM_UP = 3


class RecordedOperators(TorchDispatchMode):
    """Records the operators called in its context, so that they can be called again."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []
        self.calls: list[Callable[[], Any]] = []

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        given = dict(kwargs or {})
        self.names.append(str(func).removesuffix(".default"))
        self.calls.append(lambda: func(*args, **given))
        return func(*args, **given)


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    torch.set_num_threads(arguments.threads)
    pairs = near_pairs.collect(arguments.pairs, arguments.pairs, arguments.seed)
    scene = pairs[:1].scene()
    motions = [pairs[row : row + 1].motion("rigid") for row in range(len(pairs))]
    sorts = {"apart": motions[: arguments.pairs], "colliding": motions[arguments.pairs :]}
    rows = [row for sort, some in sorts.items() for row in measure(scene, sort, some, arguments.rounds)]
    results.table([flat(row) for row in rows])
    content = {"pairs": arguments.pairs, "triangles": len(pairs.mesh.faces), "rows": rows}
    results.write("two_bodies", "cpu", content, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--pairs", type=int, default=50, help="of either sort")
    parser.add_argument("--rounds", type=int, default=100, help="calls of each pair that are timed")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def measure(scene: pgccd.Scene, sort: str, motions: Sequence[pgccd.RigidMotion], rounds: int) -> list[dict[str, Any]]:
    """A row for the call, one for each of its operators, and one for a trivial operator; measured in turn."""
    small = torch.zeros(1)
    works: dict[str, list[Callable[[], Any]]] = {"torch.neg of one number": [lambda: torch.neg(small)] * len(motions)}
    pgccd.detect(scene, motions[0])  # computes and caches what depends only on the scene
    for motion in motions:
        with RecordedOperators() as recorded:
            found = pgccd.detect(scene, motion, report="first")
        if len(found) != (sort == "colliding"):
            raise SystemExit(f"{sort}: {len(found)} contacts")
        works.setdefault("detect", []).append(partial(pgccd.detect, scene, motion, "first"))
        for number, (name, call) in enumerate(zip(recorded.names, recorded.calls, strict=True), 1):
            works.setdefault(f"  operator {number}: {name}", []).append(call)
    spent: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(_WARM_UP + rounds):
        for each in range(len(motions)):
            for name, calls in works.items():
                duration, _ = timing.seconds(calls[each])
                if turn >= _WARM_UP:
                    spent[name].append(duration)
    return [{"bodies": sort, "work": name, "us": timing.summary(times, 1e6)} for name, times in spent.items()]


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """A row of the table."""
    return {"bodies": row["bodies"], "work": row["work"], "us": row["us"]["median"], "low10": row["us"]["low10"]}


if __name__ == "__main__":
    main()
