"""The evaluation of Du, Liu & Suzumura (2017) repeated: cases, and the ranks that measure them.

One process first advances a world. From there ranks repeat the same steps: the simulation (PGCCD, with or without load
balancing), and the voxel-based baseline (PCCCD), which detects the collisions of the same planned motions. Both must
find the contacts of the single process, compared by hash.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from pgccd import distributed, sim
from pgccd.sim.model import Pattern
from support import results

_RANKS_PROGRAM = Path(__file__).resolve().parents[1] / "evaluation_ranks.py"


@dataclass(frozen=True)
class Space:
    """A model, and the partition of its space."""

    pattern: Pattern
    axes: int = 3  #: along which space is cut: 3 gives boxes, 1 slabs
    stretch: float = 1.0  #: length along x of the partitioned space over that of the world, which fills its lower part


# The worlds of the figures. The skewed world's robots gather in the eight corners. Of 2 x 2 x 1 boxes each has two
# corners; of four slabs the two in the middle have none. Where the world does not fill the partitioned space, the first
# ranks start with more than their share, as if robots had drifted.
WORLDS = {
    "random": Space("random"),
    "skewed": Space("skewed"),
    "skewed, in slabs": Space("skewed", axes=1),
    "random, off centre": Space("random", axes=1, stretch=1.25),
}


def world_of(row: dict[str, Any]) -> str:
    """The name of a row's world."""
    return next(name for name, space in WORLDS.items() if space == Space(row["pattern"], row["axes"], row["stretch"]))


@dataclass(frozen=True)
class Steps:
    """Numbers of steps to make and to measure."""

    before: int  #: by one process
    settling: int  #: by ranks, while cells migrate, before timing
    timed: int
    baseline: int  #: of the timed ones, by PCCCD


@dataclass(frozen=True)
class Case:
    """One point of a figure."""

    system: str  #: "PCCCD", "PGCCD" or "PGCCD+LB"
    device: str  #: "cpu" or "cuda"
    ranks: int
    robots: int
    pattern: Pattern
    threshold: float = 0.15  #: of the paper's policy, in "PGCCD+LB"
    axes: int = 3  #: see `Space`
    stretch: float = 1.0


_MOST_RANKS = 4  # as in the paper


def parse_arguments(description: str | None, robots: dict[str, list[int]]) -> argparse.Namespace:
    """The command line of a figure, given the default numbers of robots by device. `ranks` and `robots` are set."""
    shared = results.parser(description)
    shared.add_argument("--robots", type=int, nargs="+", help=f"default: {robots}")
    shared.add_argument("--ranks", type=int, help="figure 5: up to; default: 4, or the number of GPUs if fewer")
    shared.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if gpus() else "cpu")
    shared.add_argument("--steps-before", type=int, default=120, help="made by one process first")
    shared.add_argument("--steps-settling", type=int, default=40, help="made by ranks before the first is timed")
    shared.add_argument("--rounds", type=int, default=20, help="steps timed")
    shared.add_argument("--baseline-rounds", type=int, default=3, help="of these, by PCCCD")
    shared.add_argument("--seed", type=int, default=0)
    given = shared.parse_args()
    given.robots = given.robots or robots[given.device]
    given.ranks = given.ranks or (min(_MOST_RANKS, gpus()) if given.device == "cuda" else _MOST_RANKS)
    return given


def columns(row: dict[str, Any], *more: str) -> dict[str, Any]:
    """Columns of a row in a figure's table: the case, its time, and others."""
    shown = {"system": row["system"], "world": world_of(row), "robots": row["robots"], "ranks": row["ranks"]}
    return shown | {"ms": row["ms"]["median"]} | {name: row.get(name) for name in more}


def measure(cases: Iterable[Case], steps: Steps, seed: int = 0) -> list[dict[str, Any]]:
    """One row per case: the case, milliseconds per step, and columns that depend on the system."""
    cases = list(cases)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for robots, pattern in dict.fromkeys((case.robots, case.pattern) for case in cases):
            device = "cuda" if any(case.device == "cuda" for case in cases) else "cpu"
            prepare(folder, sim.ModelConfig(robots=robots, pattern=pattern, seed=seed), steps, device)
        # Starting ranks takes longer than most cases: cases with equal numbers of ranks share them.
        for ranks, device in dict.fromkeys((case.ranks, case.device) for case in cases):
            shared = [case for case in cases if (case.ranks, case.device) == (ranks, device)]
            rows += _on_ranks(folder, shared, steps, ranks, device)
    return rows


def world_file(folder: Path, robots: int, pattern: str) -> Path:
    """The file in which `prepare` stores a world."""
    return folder / f"{robots}-{pattern}.pt"


def prepare(folder: Path, config: sim.ModelConfig, steps: Steps, device: str) -> None:
    """Advances a world; stores the state from which ranks start, the states in which PCCCD detects, and the contact
    hashes of all later steps.
    """
    model = sim.Model(config, device=device)
    simulation = sim.Simulation.create(distributed.Alone(), model, graph=False)
    start, states, hashes = None, [], []
    for index in range(steps.before + steps.settling + steps.timed):
        if index == steps.before:
            start = simulation.state.to("cpu").columns
        timed = index - steps.before - steps.settling
        if 0 <= timed < steps.baseline:
            states.append(simulation.state.to("cpu").columns)
        made = simulation.step(index)
        if index >= steps.before:
            hashes.append(made.record["contacts_hash"])
    content = {"config": asdict(config), "start": start, "states": states, "hashes": hashes}
    torch.save(content, world_file(folder, config.robots, config.pattern))


def _on_ranks(folder: Path, cases: list[Case], steps: Steps, ranks: int, device: str) -> list[dict[str, Any]]:
    (folder / "cases.json").write_text(
        json.dumps({"cases": [asdict(case) for case in cases], "steps": asdict(steps), "device": device})
    )
    launch = [sys.executable]
    if ranks > 1:
        launch += ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    threads = max(1, len(os.sched_getaffinity(0)) // ranks)
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    subprocess.run([*launch, str(_RANKS_PROGRAM), str(folder)], check=True, env=environment)
    return json.loads((folder / "rows.json").read_text())


def gpus() -> int:
    """Number of GPUs."""
    return torch.cuda.device_count() if torch.cuda.is_available() else 0
