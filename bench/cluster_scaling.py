"""Strong and weak scaling and balance of the nanorobot world over ranks, with the time of a step by stage.

Run it once for each number of ranks; every run adds a row to the file and compares it with the rows in it:

    python bench/cluster_scaling.py --robots 4000000 --device cuda
    torchrun --nproc-per-node 4 bench/cluster_scaling.py --robots 4000000 --device cuda
    torchrun --nproc-per-node 4 bench/cluster_scaling.py --robots-a-rank 1000000 --device cuda

Steps run consecutively as in a simulation; a step lasts from the end of the one before, which is common to all ranks.
`waiting` is the time a rank spends in the all-gather of the outcome. Times depend on the hosts: `host_loop_ms` is the
time of a plain Python loop run on all ranks at once at the end; compare it before comparing rows.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from support import results, timing

from pgccd import distributed, sim
from pgccd.distributed.launch.connect import TRANSPORTS
from pgccd.distributed.partition.balance import POLICIES
from pgccd.distributed.partition.cut import make_partition

# Groups of stages.
PARTS = {
    "plan": ("plan",),
    "detect": ("bounds", "broad", "traverse", "narrow"),
    "halo": ("halo", "halo wait"),
    "respond": ("respond",),
    "migrate": ("migrate",),
    "balance": ("balance",),
    "waiting": ("gather",),
    "hash": ("hash",),
}
# Remainder of a step: host time between stages. Negative where a GPU overlaps stages: ghosts are processed during the
# tests of own pairs.
REST = "rest"


# What a single rank's record leaves out.
_ALONE: dict[str, Any] = {"imbalance": 1.0, "busy_seconds": [1.0], "ghosts": [0], "moved_cells": 0}


def main() -> None:
    """Runs the benchmark on all ranks; rank 0 writes the result."""
    arguments = parse_arguments()
    if arguments.device == "cpu":
        torch.set_num_threads(1)
    with distributed.connect(arguments.device, arguments.transport) as comm:
        row = measure(comm, arguments)
        if comm.rank == 0:
            report(row, transport_of(comm), arguments)


def transport_of(comm: distributed.Comm) -> str:
    """How messages were sent."""
    return comm.transport + (", peer memory" if comm.peer_messages is not None else "")


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--robots", type=int, default=20_000, help="in all (strong scaling)")
    size.add_argument("--robots-a-rank", type=int, help="weak scaling")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--transport", choices=TRANSPORTS, default="auto")
    parser.add_argument("--pattern", choices=sim.PATTERNS, default="random")
    parser.add_argument("--balance", choices=POLICIES, default="cost")
    parser.add_argument("--cells", type=int, default=16, help="of each rank: M x M")
    parser.add_argument("--partition", choices=("cells", "bisection"), default="bisection", help="how space is cut")
    parser.add_argument("--axes", type=int, choices=(1, 2, 3), default=3)
    parser.add_argument("--no-overlap", action="store_true", help="wait for ghosts first")
    parser.add_argument("--no-graph", action="store_true", help="eager steps instead of replays of a CUDA graph")
    parser.add_argument("--steps-before", type=int, default=20, help="steps made before the first is timed")
    parser.add_argument("--rounds", type=int, default=20, help="steps timed")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def measure(comm: distributed.Comm, arguments: argparse.Namespace) -> dict[str, Any]:
    """One row, equal on all ranks."""
    weak = arguments.robots_a_rank is not None
    robots = arguments.robots_a_rank * comm.size if weak else arguments.robots
    config = sim.ModelConfig(robots=robots, pattern=arguments.pattern, seed=arguments.seed)
    device = distributed.choose_device(arguments.device)
    simulation = start(comm, config, device, arguments)
    for index in range(arguments.steps_before):
        simulation.step(index)
    begin = arguments.steps_before
    end = begin + 1 + arguments.rounds
    durations, records = follow(comm, begin, arguments.rounds, lambda index: simulation.step(index, more=end - index))
    mine = durations, [parts_of(*step) for step in zip(records, durations, strict=True)]
    of_ranks = comm.broadcast_object(comm.gather_objects(mine))
    whole = [max(steps) for steps in zip(*(times for times, _ in of_ranks), strict=True)]
    parts = [steps for _, steps in of_ranks]
    host_loop_ms = comm.gather_objects(timing.rounded(1e3 * timing.host_loop()))
    ranks = [record.get("ranks", _ALONE) for record in records]
    return {
        "scaling": "weak" if weak else "strong",
        "ranks": comm.size,
        "robots": robots,
        "pattern": arguments.pattern,
        "balance": arguments.balance,
        "partition": arguments.partition,
        "cells": arguments.cells,
        "axes": arguments.axes,
        "overlap": not arguments.no_overlap,
        "graph": not arguments.no_graph,
        "ms": timing.summary(whole),
        "mean_of_ranks_ms": {name: over_ranks(parts, name, mean) for name in (*PARTS, REST)},
        "slowest_rank_ms": {name: over_ranks(parts, name, max) for name in (*PARTS, REST)},
        "imbalance_by_step": [step["imbalance"] for step in ranks],
        "busy_imbalance": timing.rounded(mean([ratio(step["busy_seconds"]) for step in ranks])),
        "ghosts_a_body": timing.rounded(mean([sum(step["ghosts"]) / robots for step in ranks])),
        "moved_cells_a_step": timing.rounded(mean([step["moved_cells"] for step in ranks])),
        "host_loop_ms": host_loop_ms,
        "state_hash": records[-1]["state_hash"],
    }


def start(
    comm: distributed.Comm, config: sim.ModelConfig, device: torch.device, arguments: argparse.Namespace
) -> sim.Simulation:
    """The world before step 0."""
    model = sim.Model(config, device=device)
    x, y, z = model.half_extent
    cut = (-x, -y, -z), (x, y, z), comm.size, arguments.axes, arguments.cells, device
    partition = make_partition(arguments.partition, *cut)
    share = sim.starting_share(comm, model)
    balance = distributed.BalanceOptions(arguments.balance)
    graph = False if arguments.no_graph else None
    overlap = not arguments.no_overlap
    options = distributed.RankOptions(balance=balance, overlap=overlap)
    return sim.Simulation.create(comm, model, partition, share, options, graph)


def follow(
    comm: distributed.Comm, begin: int, rounds: int, step: Callable[[int], sim.Step | sim.CommittedStep]
) -> tuple[list[float], list[dict[str, Any]]]:
    """Durations (seconds) and log records of `rounds` consecutive steps, after one untimed step."""
    comm.barrier()
    last = step(begin)
    end, durations, records = time.perf_counter(), [], []
    for index in range(begin + 1, begin + 1 + rounds):
        made = step(index)
        former, end = end, time.perf_counter()
        durations.append(end - former)
        # As in a simulation: a step's record is written after the next step.
        records.append(last.record)
        last = made
    return durations, [*records[1:], last.record]


def parts_of(record: dict[str, Any], duration: float) -> dict[str, float]:
    """Seconds of a step on one rank, by group of stages."""
    spent = {name: sum(record["stage_seconds"].get(stage, 0.0) for stage in stages) for name, stages in PARTS.items()}
    return spent | {REST: duration - sum(spent.values())}


def over_ranks(parts: list[list[dict[str, float]]], name: str, combine: Any) -> float:
    """Median over the steps of the mean or maximum over ranks, milliseconds."""
    steps = [combine([rank[step][name] for rank in parts]) for step in range(len(parts[0]))]
    return timing.summary(steps)["median"]


def mean(values: list[float]) -> float:
    """Mean of a nonempty list."""
    return sum(values) / len(values)


def ratio(values: list[float]) -> float:
    """The largest over the mean."""
    return max(values) / mean(values)


def report(row: dict[str, Any], transport: str, arguments: argparse.Namespace) -> None:
    """Adds the row to the file, and prints all rows."""
    path = arguments.out or results.FOLDER / f"cluster_scaling-{arguments.device.partition(':')[0]}.json"
    known = json.loads(Path(path).read_text()) if Path(path).exists() else {}
    rows = known.get("rows", [])
    key = (
        "scaling",
        "ranks",
        "robots",
        "pattern",
        "balance",
        "partition",
        "cells",
        "axes",
        "overlap",
        "graph",
        "transport",
    )
    row["transport"] = transport
    row["commit"] = results.versions()["commit"]  # other rows may come from other versions
    rows = [other for other in rows if [other.get(name) for name in key] != [row[name] for name in key]] + [row]
    rows.sort(key=lambda other: (other["scaling"], other["pattern"], other["ranks"], other["robots"]))
    results.table([flat(other, rows) for other in rows])
    print(f"\nmilliseconds of this run, {row['robots']:,} robots on {row['ranks']} ranks:")
    results.table(by_stage(row))
    results.write("cluster_scaling", arguments.device, {"rows": rows}, Path(path))


def by_stage(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The time of a step by stage, as table rows."""
    mean_ms, slowest_ms = row["mean_of_ranks_ms"], row["slowest_rank_ms"]
    stages = [{"stage": name, "mean of ranks": mean_ms[name], "slowest rank": slowest_ms[name]} for name in mean_ms]
    return [*stages, {"stage": "whole step", "mean of ranks": row["ms"]["median"], "slowest rank": None}]


def flat(row: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The row as table columns, with its efficiency relative to one rank in the same world."""
    a_rank = row["robots"] // row["ranks"]
    wanted = row["robots"] if row["scaling"] == "strong" else a_rank
    base = [
        other
        for other in rows
        if other["ranks"] == 1 and other["robots"] == wanted and other["pattern"] == row["pattern"]
    ]
    efficiency = None
    if base:
        share = row["ranks"] if row["scaling"] == "strong" else 1
        efficiency = timing.alone_ms(base[0]) / row["ms"]["median"] / share
    return {
        "scaling": row["scaling"],
        "world": row["pattern"],
        "ranks": row["ranks"],
        "robots": row["robots"],
        "ms": row["ms"]["median"],
        "efficiency": efficiency,
        **{f"{name} ms": value for name, value in row["mean_of_ranks_ms"].items()},
        "ghosts/body": row["ghosts_a_body"],
        "imbalance": row["imbalance_by_step"][-1],
        "moved cells": row["moved_cells_a_step"],
    }


if __name__ == "__main__":
    main()
