"""Cost of the decomposition on one rank as the number of ranks grows with constant bodies per rank.

One rank in the middle of 64 to 4,096 is simulated: its part of the world with a quarter of a million robots (10^9 in
all on 4,096 ranks), its neighbours, boundary bodies, the ranks that hold these, its near ghosts, and the bodies that
migrate. Both partitions; the table of replicas with a column per neighbour, and per rank as used up to
`Comm.neighbours_above` ranks. The planes of a bisection are searched once, as by one of many ranks with equal loads. No
messages are sent; those of the counts of ghosts and migrating bodies in a step are listed: 8 bytes to each neighbour,
or to each rank in a collective call.

    python bench/rank_growth.py
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import torch
from support import results, timing
from torch import Tensor

from pgccd import ops, sim
from pgccd.distributed import Alone, Bisection, Cells
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.halo.replicas import find_replicas
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition

_KEPT = (0.0, 0.0)


class SameElsewhere(Alone):
    """One of many ranks that all have the same data."""

    def __init__(self, rank: int, size: int) -> None:
        super().__init__()
        self.sums = 0
        self.rank, self.size = rank, size

    def sum(self, values: Tensor) -> Tensor:
        self.sums += 1
        return values * self.size


def main() -> None:
    """Runs the benchmark."""
    arguments = parse_arguments()
    rows = [row for ranks in arguments.ranks for row in measure(ranks, arguments)]
    results.table(rows)
    content = {"robots_a_rank": arguments.robots_a_rank, "rounds": arguments.rounds, "rows": rows}
    results.write("rank_growth", "cpu", content, arguments.out)


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--robots-a-rank", type=int, default=244_141)
    parser.add_argument("--ranks", type=int, nargs="+", default=[64, 256, 1024, 4096])
    parser.add_argument("--rounds", type=int, default=5, help="of which the median is taken")
    return parser.parse_args()


def measure(ranks: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """One row per partition."""
    torch.set_num_threads(1)  # as for a rank that shares a machine
    world = sim.Model(sim.ModelConfig(robots=arguments.robots_a_rank * ranks))
    x, y, z = world.half_extent
    lower, upper = (-x, -y, -z), (x, y, z)
    return [
        measure_partition(kind, make(), world, ranks, arguments)
        for kind, make in {
            "cells": lambda: Cells.uniform(lower, upper, ranks),
            "bisection": lambda: Bisection.uniform(lower, upper, ranks),
        }.items()
    ]


def measure_partition(
    kind: str, partition: Partition, world: sim.Model, ranks: int, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Times and bytes of one rank."""
    rank = ranks // 2 + ranks // 16
    low, high = part_of(partition, rank)
    generator = torch.Generator().manual_seed(1)

    def place(count: int) -> Tensor:
        return low + (high - low) * torch.rand((count, 3), generator=generator, dtype=torch.float64)

    start = place(arguments.robots_a_rank)
    step = world.config.speed * world.radius * torch.randn(start.shape, generator=generator, dtype=torch.float64)
    centres = start, start + step, torch.full((len(start),), world.radius, dtype=torch.float64)
    comm = SameElsewhere(rank, ranks)
    near, everywhere = Decomposition(comm, partition), Decomposition(comm, partition, Neighbourhood(comm))

    def median_ms(work: Callable[[], Any]) -> float:
        samples = [timing.seconds(work)[0] for _ in range(arguments.rounds)]
        return timing.summary(samples)["median"]

    reach, rows, count = ops.boundary_bodies(centres, 0.0, 0.0, *near.subdomain)
    rows = rows[: int(count)]
    ghosts = [column[rows] for column in centres]
    row: dict[str, Any] = {"ranks": ranks, "partition": kind, "boundary bodies": len(rows)}
    row["neighbours"] = len(near.neighbours.ranks) - 1
    row["neighbours ms"] = median_ms(lambda: Decomposition(comm, partition))
    row["boundary ms"] = median_ms(lambda: ops.boundary_bodies(centres, 0.0, 0.0, *near.subdomain))
    for name, decomposition in (("replicas", near), ("replicas of all ranks", everywhere)):
        found = find_replicas(decomposition, centres, _KEPT, rows)
        counts = found.counts.tolist()
        row[f"{name} ms"] = median_ms(
            lambda: find_replicas(decomposition, centres, _KEPT, rows).rows_by_rank(rows, counts)  # noqa: B023
        )
        row[f"{name} kB"] = round((found.table.nbytes + found.counts.nbytes) / 1e3)
    row["reached ranks"] = sum(count > 0 for count in counts)
    row["bodies beyond neighbours"] = int(find_replicas(near, centres, _KEPT, rows).counts[-1])
    row["count messages"], row["count messages of all ranks"] = 2 * row["neighbours"], 2 * (ranks - 1)
    row["near ms"] = median_ms(lambda: ops.near_ghosts(centres, reach, ghosts, 0.0, 0.0, *near.subdomain))
    row["leaving ms"] = median_ms(lambda: ops.leaving_bodies(centres[1], *near.subdomain, near.neighbours.size))
    frame, owner, _ = near.subdomain
    row["partition kB"] = round(owner.nbytes / 1e3)
    # Cells 64 apart share a box (csrc/kernels/broad/subdomain_item.h).
    row["boxes of near ghosts kB"] = round(48 * math.prod(min(int(count), 64) for count in frame[6:]) / 1e3)
    if isinstance(partition, Bisection):
        weights = torch.ones(len(start), dtype=torch.int64)
        shares = [1.0] * ranks
        row["planes ms"] = timing.rounded(
            1e3 * timing.seconds(lambda: partition.rebalanced(comm, start, weights, shares))[0]
        )
        row["sums over ranks"] = comm.sums
    return row


def part_of(partition: Partition, rank: int) -> tuple[Tensor, Tensor]:
    """The corners of a rank's region."""
    if isinstance(partition, Bisection):
        low, high = partition.boxes[rank]
        return torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    assert isinstance(partition, Cells)
    at = torch.stack(torch.unravel_index(torch.tensor(rank), partition.subdomains)).double()
    world_low, world_high = (torch.tensor(x, dtype=torch.float64) for x in (partition.lower, partition.upper))
    size = (world_high - world_low) / torch.tensor(partition.subdomains)
    return world_low + at * size, world_low + (at + 1.0) * size


if __name__ == "__main__":
    main()
