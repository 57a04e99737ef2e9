"""Limits of scaling to 64 to 1,024 GPUs: the actual decomposition of up to a billion bodies (on the CPU, in blocks,
without detection), and a model of a step's time based on it.

Counted for every number of ranks: bodies, ghosts and neighbours of each rank, bytes of the halo, size of the cell
table. Then a skewed density (a peak in each corner of the box) is balanced for some steps by the policy of
`pgccd.distributed.partition.balance`.

The model of a step, which is one CUDA graph per rank, is the sum for the most loaded rank of:

* alone: a step of one process, linear in its robots
* imbalance: that, times the excess load of the most loaded rank
* ghosts: time per ghost
* many: extra time of a step of several ranks on one host: NCCL calls, and rounds that start later
* halo: between hosts: messages x latency + bytes / bandwidth
* resolution: between hosts: `--rounds` + 1 exchanges of 8 bytes per ghost, each way
* gather: between hosts: two all-gathers, of 500 bytes per rank in all
* balance: between hosts, one decision in `--decide-every` steps: 4 log2 P sums of 64 bins per part of space. The work
  of a decision on the device is not included.

Rows of one rank in bench/results/cluster_scaling-cuda.json determine "alone" (one line per pattern), its rows of two
ranks "ghosts" and "many" (the same for both patterns), by least squares of relative errors. All residuals are listed.
So are predictions for measurements to which the model is not fitted: four ranks, and the steps of
bench/results/steps-cuda.json. Nothing between hosts was measured:
`--latency-us` and `--gigabytes` are assumptions. Robots have the size, the speed and the density of the standard world
and are spread evenly; they are counted in uniform cells, whose ghosts and neighbours are about those of a bisection.

    python bench/cluster_model.py --robots 1000000000 --ranks 1024
    python bench/cluster_model.py --counted  # only the model, from earlier counts
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

import torch
from support import results, timing

from pgccd import ops, sim
from pgccd.distributed import BalanceOptions, Cells
from pgccd.distributed.partition.balance import CellLoads, imbalance, rank_loads, rebalance

_BLOCK = 1 << 20
_STATE_BYTES = 112  # per robot in the halo
_GHOST_BYTES = 8  # each way in a round
_RECORD_BYTES = 500
_BIN_BYTES = 64 * 8  # per part of space in one of the sums for new planes


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    path = arguments.out or results.FOLDER / "cluster_model-cpu.json"
    known = json.loads(path.read_text())["rows"] if path.exists() else []
    scaling = json.loads((results.FOLDER / "cluster_scaling-cuda.json").read_text())
    measured = Measured(scaling["rows"])
    steps = json.loads((results.FOLDER / "steps-cuda.json").read_text())
    check = measured.check + measured.check_steps(steps)
    rows = [] if arguments.counted else count(arguments)
    new = [(row["ranks"], row["robots"]) for row in rows]
    rows += [row for row in known if (row["ranks"], row["robots"]) not in new]
    rows.sort(key=lambda row: (row["ranks"], row["robots"]))
    for row in rows:
        row["model"] = model(row, arguments, measured)
        row["model_skewed"] = model(row, arguments, measured, row["skewed"]["imbalance"][-1])
    results.table([flat(row) for row in rows])
    print("\nmeasured on one host, and the model:")
    results.table(check)
    assumed = {
        name: value for name, value in vars(arguments).items() if name not in ("out", "ranks", "robots", "counted")
    }
    content = {"assumed": assumed | measured.fitted, "check": check, "rows": rows}
    results.write("cluster_model", "cpu", content, path)


def count(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The decompositions of one world for all numbers of ranks."""
    model = sim.Model(sim.ModelConfig(robots=arguments.robots))
    begin = time.perf_counter()
    counts = [Counts(model, ranks, arguments) for ranks in arguments.ranks]
    for first in range(0, arguments.robots, _BLOCK):
        state = model.start(torch.arange(first, min(arguments.robots, first + _BLOCK)))
        # Random positions: in the initial lattice, whole layers would lie on one side of a boundary.
        place = ops.random_uniforms(state.id, 0, 0, 0)[:, :3] - 0.5
        state.position = 2.0 * place * torch.tensor(model.half_extent, dtype=torch.float64)
        motion, radius = model.motion(state), model.scene(state.id).radius
        for each in counts:
            each.add(motion, radius)
    print(f"counted in {time.perf_counter() - begin:.0f} s")
    return [each.row(arguments) for each in counts]


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots", type=int, default=10_000_000, help="in all, up to 2^31 - 1")
    parser.add_argument("--ranks", type=int, nargs="+", default=[64, 128, 256, 512, 1024])
    parser.add_argument("--cells", type=int, default=16, help="of each rank: M x M")
    parser.add_argument("--axes", type=int, choices=(1, 2, 3), default=3)
    parser.add_argument("--counted", action="store_true", help="count nothing: only the model, for what is known")
    parser.add_argument("--latency-us", type=float, default=10.0, help="of a message between machines")
    parser.add_argument("--gigabytes", type=float, default=50.0, help="a second and rank between machines")
    parser.add_argument("--rounds", type=int, default=6, help="of collision resolution a step")
    parser.add_argument("--decide-every", type=int, default=64, help="steps between decisions of load balancing")
    parser.add_argument("--balance-steps", type=int, default=30, help="of the skewed density")
    return parser.parse_args()


class Measured:
    """Model parameters fitted to measurements on one host; `check` compares predictions with measurements.

    Args:
        rows: of cluster_scaling.py, for one and two ranks and maybe more.
    """

    def __init__(self, rows: list[dict[str, Any]]) -> None:
        rows = [row for row in rows if row["overlap"] and "disturbed" not in row]
        alone: dict[str, list[tuple[float, float]]] = {}
        for row in rows:
            if row["ranks"] == 1:
                point = row["robots"], timing.alone_ms(row)
                alone.setdefault(row["pattern"], []).append(point)
        #: By pattern: milliseconds of a step of no robots, and per robot.
        self.line = {
            pattern: relative_fit([[1.0, robots] for robots, _ in points], [ms for _, ms in points])
            for pattern, points in alone.items()
            if len(points) > 1
        }
        rows = [row for row in rows if row["pattern"] in self.line]
        of_two = [row for row in rows if row["ranks"] == 2]
        rest = [row["ms"]["median"] - self.own(row) for row in of_two]
        weights = [row["ms"]["median"] for row in of_two]
        #: Milliseconds of several ranks, and per ghost.
        self.many_ms, self.ghost_ms = relative_fit([[1.0, ghosts_of(row)] for row in of_two], rest, weights)
        self.check = [self.compared(row) for row in rows]

    def own(self, row: dict[str, Any]) -> float:
        """The prediction for the own robots of the most loaded rank of a measured row."""
        fixed, per_robot = self.line[row["pattern"]]
        return fixed + per_robot * row["robots"] / row["ranks"] * row["imbalance_by_step"][-1]

    def compared(self, row: dict[str, Any]) -> dict[str, Any]:
        """A measured row, and the prediction."""
        several = row["ranks"] > 1
        measured = row["ms"]["median"] if several else timing.alone_ms(row)
        predicted = self.own(row) + several * (self.many_ms + self.ghost_ms * ghosts_of(row))
        names = ("ranks", "robots", "pattern", "commit")
        fitted = {"fitted to": row["ranks"] <= 2}
        return {name: row[name] for name in names} | residual(measured, predicted) | fitted

    def check_steps(self, steps: dict[str, Any]) -> list[dict[str, Any]]:
        """Steps of one process, to which the model is not fitted."""
        fixed, per_robot = self.line[steps["pattern"]]
        commit = steps["made"]["versions"]["commit"]
        return [
            {"ranks": 1, "robots": row["robots"], "pattern": steps["pattern"], "commit": commit}
            | residual(row["wall_ms"], fixed + per_robot * row["robots"])
            | {"fitted to": False}
            for row in steps["rows"]
            if row["graph"] and row["host"] == "idle"
        ]

    @property
    def fitted(self) -> dict[str, Any]:
        """The fitted parameters."""
        lines = {pattern: [timing.rounded(x) for x in line] for pattern, line in self.line.items()}
        several = {"many_ms": timing.rounded(self.many_ms), "ghost_ms": timing.rounded(self.ghost_ms)}
        return {"ms of a step, per robot": lines, **several}


def relative_fit(columns: list[list[float]], values: list[float], scales: list[float] | None = None) -> list[float]:
    """Coefficients of the columns (one row per value) with the least sum of squares of (error / scale). Default scales:
    the values.
    """
    scale = torch.tensor(scales or values, dtype=torch.float64)
    matrix = torch.tensor(columns, dtype=torch.float64) / scale[:, None]
    target = torch.tensor(values, dtype=torch.float64) / scale
    return torch.linalg.lstsq(matrix, target[:, None], driver="gelsd").solution[:, 0].tolist()


def ghosts_of(row: dict[str, Any]) -> float:
    """Mean ghosts of a rank in a measured row."""
    return row["ghosts_a_body"] * row["robots"] / row["ranks"]


def residual(measured: float, predicted: float) -> dict[str, Any]:
    """Columns of a comparison."""
    off = f"{100.0 * (predicted / measured - 1.0):+.1f}"
    return {"measured ms": measured, "model ms": timing.rounded(predicted), "residual %": off}


class Counts:
    """The decomposition for one number of ranks, counted block by block."""

    def __init__(self, model: sim.Model, ranks: int, arguments: argparse.Namespace) -> None:
        x, y, z = model.half_extent
        upper = (x, y, z)
        self.partition = Cells.uniform((-x, -y, -z), upper, ranks, axes=arguments.axes, cells=arguments.cells)
        self.bodies = torch.zeros(self.partition.cell_count, dtype=torch.int64)
        #: by (source, destination).
        self.ghosts = torch.zeros(ranks * ranks, dtype=torch.int64)

    def add(self, motion: Any, radius: torch.Tensor) -> None:
        """Counts a block of bodies."""
        partition, ranks = self.partition, self.partition.ranks
        centres = motion.position_t0, motion.position_t1, radius
        centre = partition.cell_of(motion.position_t0)
        self.bodies += torch.bincount(centre, minlength=partition.cell_count)
        owner = partition.owner[centre]
        first, last = (partition.cell_of(corner) for corner in ops.swept_boxes(centres, 0.0, 0.0))
        for rows in torch.nonzero(first != last)[:, 0].split(max(1, _BLOCK // ranks)):
            reached, _ = ops.replica_ranks(centres, 0.0, 0.0, *partition.subdomain(0), rows, [], ranks)
            if ranks > 1:  # the operator omits the calling rank
                reached[:, 0] = ops.replica_ranks(centres, 0.0, 0.0, *partition.subdomain(1), rows, [], ranks)[0][:, 0]
            row, destination = torch.nonzero(reached).unbind(dim=1)
            source = owner[rows[row]]
            away = source != destination
            self.ghosts += torch.bincount((source * ranks + destination)[away], minlength=ranks * ranks)

    def row(self, arguments: argparse.Namespace) -> dict[str, Any]:
        """Counts, and the balancing of a skewed density."""
        partition, ranks = self.partition, self.partition.ranks
        table = self.ghosts.view(ranks, ranks)
        sent, received = table.sum(1), table.sum(0)
        neighbours = (table > 0).sum(1)
        own = rank_loads(self.bodies, partition.owner, ranks)
        balance = balance_skewed(partition, arguments.balance_steps)
        return {
            "ranks": ranks,
            "robots": int(own.sum()),
            "subdomains": partition.subdomains,
            "cells": partition.cell_count,
            "table_bytes": 8 * partition.cell_count,
            "bodies_a_rank": spread(own),
            "ghosts_a_rank": spread(received),
            "neighbours_a_rank": spread(neighbours),
            "halo_bytes_a_rank": spread(sent * _STATE_BYTES),
            "skewed": balance,
        }


def spread(values: torch.Tensor) -> dict[str, float]:
    """Minimum, mean and maximum."""
    return {
        "least": int(values.min()),
        "mean": timing.rounded(float(values.double().mean())),
        "most": int(values.max()),
    }


def balance_skewed(partition: Cells, steps: int) -> dict[str, Any]:
    """Imbalance per step for robots concentrated in the eight corners, at four times the average density."""
    centre = [(torch.arange(count) + 0.5) / count for count in partition.grid]
    off = torch.stack(
        [torch.minimum(axis, 1.0 - axis)[index] for axis, index in zip(centre, _grid(partition), strict=True)]
    )
    density = 1.0 + 12.0 * torch.exp(-((off / 0.12) ** 2).sum(dim=0))
    bodies = (1e9 / len(density) * density / density.mean()).long()
    pairs = (bodies * density / density.mean() * 0.75).long()  # the number of partners is proportional to the density
    loads = CellLoads(bodies, pairs, pairs // 20)
    seen, moved, decision = [], [], []
    for _ in range(steps):
        seen.append(timing.rounded(imbalance(rank_loads(loads.cost, partition.owner, partition.ranks))))
        begin = time.perf_counter()
        new = rebalance(partition, loads, BalanceOptions("cost"))
        decision.append(time.perf_counter() - begin)
        moved.append(int((new.owner != partition.owner).sum()))
        partition = new
    return {
        "imbalance": seen,
        "moved_cells": moved,
        "longest_decision_ms": timing.rounded(1e3 * max(decision)),
        "decision_ms": timing.rounded(1e3 * decision[-1]),
    }


def _grid(partition: Cells) -> tuple[torch.Tensor, ...]:
    return torch.unravel_index(torch.arange(partition.cell_count), partition.grid)


def model(
    row: dict[str, Any], arguments: argparse.Namespace, measured: Measured, uneven: float | None = None
) -> dict[str, Any]:
    """Milliseconds of a step on the most loaded rank, and the efficiency relative to one GPU with its share."""
    ranks, latency = row["ranks"], 1e-3 * arguments.latency_us
    a_millisecond = 1e6 * arguments.gigabytes
    bodies, ghosts = row["bodies_a_rank"]["mean"], row["ghosts_a_rank"]["most"]
    messages, halo_bytes = row["neighbours_a_rank"]["most"], row["halo_bytes_a_rank"]["most"]
    uneven = uneven or row["bodies_a_rank"]["most"] / bodies
    levels = math.ceil(math.log2(ranks))
    fixed, per_robot = measured.line["random"]
    alone = fixed + per_robot * bodies
    sums = 4.0 * (levels * 2.0 * levels * latency + 2.0 * _BIN_BYTES * ranks / a_millisecond)
    parts = {
        "alone": alone,
        "imbalance": per_robot * bodies * (uneven - 1.0),
        "ghosts": measured.ghost_ms * ghosts,
        "many": measured.many_ms,
        "halo": messages * latency + halo_bytes / a_millisecond,
        "resolution": (arguments.rounds + 1) * (messages * latency + _GHOST_BYTES * ghosts / a_millisecond),
        "gather": 2.0 * levels * latency + _RECORD_BYTES * ranks / a_millisecond,
        "balance": sums / arguments.decide_every,
    }
    total = sum(parts.values())
    return {
        "ms": timing.rounded(total),
        "parts_ms": {name: timing.rounded(part) for name, part in parts.items()},
        "efficiency": timing.rounded(alone / total),
    }


def flat(row: dict[str, Any]) -> dict[str, Any]:
    """The row as table columns."""
    ghosts = row["ghosts_a_rank"]["most"] / row["bodies_a_rank"]["mean"]
    limits = sorted(row["model"]["parts_ms"].items(), key=lambda item: -item[1])[1]
    return {
        "ranks": row["ranks"],
        "robots/rank": row["bodies_a_rank"]["mean"],
        "ghosts/rank": row["ghosts_a_rank"]["most"],
        "ghosts/body": ghosts,
        "messages": row["neighbours_a_rank"]["most"],
        "halo MB": row["halo_bytes_a_rank"]["most"] / 1e6,
        "table kB": row["table_bytes"] / 1e3,
        "model ms": row["model"]["ms"],
        "efficiency": row["model"]["efficiency"],
        "first limit": limits[0],
        "skewed": f"{row['skewed']['imbalance'][0]:.2f} -> {row['skewed']['imbalance'][-1]:.2f}",
        "eff. skewed": row["model_skewed"]["efficiency"],
        "longest decision ms": row["skewed"]["longest_decision_ms"],
    }


if __name__ == "__main__":
    main()
