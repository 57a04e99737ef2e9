"""Limits of scaling to 64 to 1,024 GPUs: the actual decomposition of up to a billion bodies (on the CPU, in blocks,
without detection), and a model of a step's time based on it.

Counted for every number of ranks: bodies, ghosts and neighbours of each rank, bytes of the halo, size of the cell
table. Then a skewed density (a peak in each corner of the box) is balanced for some steps by the policy of
`pgccd.distributed.partition.balance`. The model sums, for the most loaded rank:

    alone       a step of one process: linear in its robots, through the measurements of the smallest and the largest
    number (bench/results/cluster_scaling-cuda.json) imbalance   that, times the excess load of the most loaded rank
    ghosts time per robot, times the ghosts many        extra time of a step of two ranks on one host: launches and NCCL
    calls halo        between hosts: messages x latency + bytes / bandwidth, out and in, for halo and migration
    resolution  between hosts: `--rounds` x one exchange of 16 bytes per ghost gather      between hosts: one all-gather
    of 900 bytes per rank balance     between hosts: one all-reduce of 24 bytes per cell; and the decision, timed here
    once the loads are even

and gives each term's share of the step. Robots have the size, the speed and the density of the standard world and are
spread evenly. Its prediction for four ranks on one host, to which it is not fitted, is listed next to the measurement;
also for the rows of an earlier version, with its own fit.

    python bench/cluster_model.py --robots 1000000000 --ranks 1024 python bench/cluster_model.py --counted  # only the
    model, from earlier counts
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
from pgccd.distributed import BalanceOptions, CellLoads, Cells, imbalance, rebalance
from pgccd.distributed.partition.balance import rank_loads

_BLOCK = 1 << 20
_STATE_BYTES = 112  # per robot in the halo
_GHOST_BYTES = 16  # both ways in a round
_RECORD_BYTES = 900
_CELL_BYTES = 24


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    path = arguments.out or results.FOLDER / "cluster_model-cpu.json"
    known = json.loads(path.read_text())["rows"] if path.exists() else []
    scaling = json.loads((results.FOLDER / "cluster_scaling-cuda.json").read_text())
    measured, earlier = Measured(scaling["rows"]), Measured(scaling.get("earlier_rows", []))
    check = measured.check + earlier.check
    rows = [] if arguments.counted else count(arguments)
    new = [(row["ranks"], row["robots"]) for row in rows]
    rows += [row for row in known if (row["ranks"], row["robots"]) not in new]
    rows.sort(key=lambda row: (row["ranks"], row["robots"]))
    for row in rows:
        row["model"] = model(row, arguments, measured)
        row["model_skewed"] = model(row, arguments, measured, row["skewed"]["imbalance"][-1])
    results.table([flat(row) for row in rows])
    print("\nmeasured on one host, and what the model says:")
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
    parser.add_argument("--balance-steps", type=int, default=30, help="of the skewed density")
    return parser.parse_args()


class Measured:
    """Model parameters fitted to measurements on one host; `check` compares predictions with measurements.

    Args:
        rows: of cluster_scaling.py, at least for one and two ranks; or empty.
    """

    def __init__(self, rows: list[dict[str, Any]]) -> None:
        rows = [row for row in rows if row["pattern"] == "random" and row["overlap"] and "disturbed" not in row]
        self.check: list[dict[str, Any]] = []
        if not rows:
            return
        alone = sorted((row["robots"], row["single_process_ms"]["median"]) for row in rows if row["ranks"] == 1)
        (few, few_ms), (many, many_ms) = alone[0], alone[-1]
        self.robot_ms = (many_ms - few_ms) / (many - few)
        self.fixed_ms = few_ms - self.robot_ms * few
        of_two = [row["ms"]["median"] - self.step(row) for row in rows if row["ranks"] == 2]
        self.many_ms = sum(of_two) / len(of_two)
        self.check = [
            {
                "ranks": row["ranks"],
                "robots": row["robots"],
                "measured ms": row["ms"]["median"],
                "model ms": timing.rounded(self.step(row) + self.many_ms),
                "fitted to": row["ranks"] == 2,
                "commit": row["commit"],
            }
            for row in rows
            if row["ranks"] > 1
        ]

    def alone(self, bodies: float) -> float:
        """Milliseconds of a step of one process."""
        return self.fixed_ms + self.robot_ms * bodies

    def step(self, row: dict[str, Any]) -> float:
        """The prediction for a measured row, without the communication term."""
        bodies = row["robots"] / row["ranks"]
        return self.alone(bodies) * row["imbalance_by_step"][-1] + self.robot_ms * bodies * row["ghosts_a_body"]

    @property
    def fitted(self) -> dict[str, float]:
        """The fitted parameters."""
        return {name: timing.rounded(value) for name, value in vars(self).items() if name != "check"}


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
        centres = [motion.position_t0, motion.position_t1, radius]
        centre = partition.cell_of(motion.position_t0)
        self.bodies += torch.bincount(centre, minlength=partition.cell_count)
        owner = partition.owner[centre]
        first, last = (partition.cell_of(corner) for corner in ops.swept_boxes(*centres, 0.0, 0.0))
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
    tree = math.ceil(math.log2(ranks)) * latency
    exchange = messages * latency
    alone = measured.alone(bodies)
    parts = {
        "alone": alone,
        "imbalance": alone * (uneven - 1.0),
        "ghosts": measured.robot_ms * ghosts,
        "many": measured.many_ms,
        "halo": 2.0 * (tree + exchange) + 2.0 * halo_bytes / a_millisecond,
        "resolution": arguments.rounds * (exchange + _GHOST_BYTES * ghosts / a_millisecond),
        "gather": tree + _RECORD_BYTES * ranks / a_millisecond,
        "balance": 2.0 * tree + 2.0 * _CELL_BYTES * row["cells"] / a_millisecond + row["skewed"]["decision_ms"],
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
