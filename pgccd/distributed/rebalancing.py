"""A partition of space whose loads are more even, from what all ranks did in a step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.balance import (
    PAIR_COST,
    BalanceOptions,
    CellLoads,
    imbalance,
    rank_loads,
    rebalance,
    relative_speeds,
)
from pgccd.distributed.bisection import Bisection
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection import Detection
from pgccd.distributed.partition import Cells, Partition, Point, Triple

#: Of `make_partition`.
PARTITIONS = ("cells", "bisection")


@dataclass(frozen=True)
class Rebalanced:
    """What a decision came to; the same on all ranks."""

    partition: Partition
    moved: int  #: cells, or planes, that changed; 0: the partition is the one before


def make_partition(
    kind: str, lower: Point, upper: Point, ranks: int, axes: int, cells: int | Triple, device: torch.device
) -> Partition:
    """At the start of a world.

    Raises:
        ValueError: naming the argument.
    """
    arguments.choice(kind, "partition", PARTITIONS)
    if kind == "bisection":
        return Bisection.uniform(lower, upper, ranks, device)
    return Cells.uniform(lower, upper, ranks, axes=axes, cells=cells, device=device)


def require_policy(partition: str, options: BalanceOptions) -> None:
    """Raises ValueError if a policy moves cells, and there are none."""
    if partition == "bisection" and options.policy == "one-cell":
        raise ValueError('balance: "one-cell" moves cells; with partition "bisection" there are none')


def rebalanced(
    comm: Comm, partition: Partition, position: Tensor, found: Detection, options: BalanceOptions, seconds: Tensor
) -> Rebalanced:
    """The partition of the next step. All ranks call it.

    Args:
        comm: between the ranks.
        partition: of the last step.
        position: (N, 3) of this rank's bodies.
        found: what it found.
        options: which policy, and how eager.
        seconds: (ranks,) float64 each was at work; for "measured".
    """
    if isinstance(partition, Cells):
        total = CellLoads.unstacked(comm.sum(cell_loads(partition, position, found).stacked()))
        after = rebalance(partition, total, options, seconds)
        moved = int((after.owner != partition.owner).sum())
        return Rebalanced(after, moved)
    assert isinstance(partition, Bisection)
    return _bisected(comm, partition, position, found, options, seconds)


def cell_loads(partition: Cells, position: Tensor, found: Detection) -> CellLoads:
    """What one rank saw in each cell."""
    places = position, *found.reference_points()
    return CellLoads(*(torch.bincount(partition.cell_of(at), minlength=partition.cell_count) for at in places))


def _bisected(
    comm: Comm, partition: Bisection, position: Tensor, found: Detection, options: BalanceOptions, seconds: Tensor
) -> Rebalanced:
    """New planes, if what they gain over the horizon is worth the bodies that move."""
    of_pairs, _ = found.reference_points()
    points = torch.cat([position, of_pairs])
    weights = torch.full((len(points),), PAIR_COST, dtype=torch.int64, device=points.device)
    weights[: len(position)] = 1
    before = _loads(comm, partition, points, weights)
    shares = torch.ones(comm.size, dtype=torch.float64)
    if options.policy == "measured":
        shares = relative_speeds(before.cpu(), seconds)
    after = partition.rebalanced(comm, points, weights, shares.tolist())
    loads = _loads(comm, after, points, weights).cpu() / shares
    moving = comm.sum((after.owner_of(position) != comm.rank).sum().reshape(1))
    gain = (float((before.cpu() / shares).max()) - float(loads.max())) * options.horizon
    if gain <= options.moving * float(moving) / comm.size or imbalance(loads) >= imbalance(before.cpu() / shares):
        return Rebalanced(partition, 0)
    return Rebalanced(after, int((after.planes != partition.planes).any(dim=1).sum()))


def _loads(comm: Comm, partition: Partition, points: Tensor, weights: Tensor) -> Tensor:
    return comm.sum(rank_loads(weights, partition.owner_of(points), comm.size))
