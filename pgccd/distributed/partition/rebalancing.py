"""Load balancing of a partition of space, from the loads of all ranks in a step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition.balance import (
    PAIR_COST,
    BackOff,
    BalanceOptions,
    CellLoads,
    RankLoads,
    imbalance,
    rank_loads,
    rebalance,
    relative_speeds,
)
from pgccd.distributed.partition.bisection import Bisection
from pgccd.distributed.partition.cells import Cells
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition


class Places(NamedTuple):
    """Positions of one rank's work in a step."""

    bodies: Tensor  #: (N, 3): positions of bodies
    pairs: Tensor  #: (P, 3): for each pair tested, the lower corner of the intersection of the two swept boxes
    contacts: Tensor  #: (K, 3): the same for colliding pairs


class Balancer:
    """Load balancing during a loop of steps: when to decide, and the decision. All ranks call every method.

    Args:
        options: policy and thresholds.
    """

    def __init__(self, options: BalanceOptions) -> None:
        self.options, self._back_off = options, BackOff()
        self._lost = 0.0  # by imbalance since the last decision, in bodies

    def is_due(self, steps_made: int, ranks: int) -> bool:
        """Whether to decide after `steps_made` steps, if that is worthwhile."""
        return self.options.applies(steps_made, ranks) and self._back_off.is_over(steps_made)

    def is_worthwhile(self, loads: RankLoads) -> bool:
        """Whether to decide for these loads of the last step: they are not level, and the steps since the last decision
        have lost more by imbalance than a decision costs. Called once a step.
        """
        if loads.are_level(self.options):
            return False
        self._lost += loads.lost
        return self.options.policy == "one-cell" or self._lost >= self.options.deciding

    def decide(
        self, decomposition: Decomposition, places: Places, loads: RankLoads, steps_made: int
    ) -> tuple[Decomposition, int]:
        """The decomposition of the next step, and how many cells or planes moved; if 0, it is the same one.

        Args:
            decomposition: of the last step.
            places: of this rank's work in it.
            loads: of all ranks in it.
            steps_made: number of steps made.
        """
        comm, seconds = decomposition.comm, torch.tensor(loads.seconds, dtype=torch.float64)
        partition, moved = rebalanced(comm, decomposition.partition, places, self.options, seconds)
        self._back_off.tried(steps_made, moved)
        self._lost = 0.0
        return (Decomposition(comm, partition) if moved else decomposition), moved


def rebalanced(
    comm: Comm, partition: Partition, places: Places, options: BalanceOptions, seconds: Tensor
) -> tuple[Partition, int]:
    """The partition of the next step, and the number of cells or planes that changed; 0: it is the same partition. All
    ranks call it.

    Args:
        comm: between the ranks.
        partition: of the last step.
        places: of this rank's work in it.
        options: policy and thresholds.
        seconds: (ranks,) float64 of work of each rank; for "measured".
    """
    if isinstance(partition, Cells):
        total = CellLoads(*comm.sum(torch.stack(list(vars(cell_loads(partition, places)).values()))))
        after = rebalance(partition, total, options, seconds)
        return after, int((after.owner != partition.owner).sum())
    assert isinstance(partition, Bisection)
    return _bisected(comm, partition, places, options, seconds)


def cell_loads(partition: Cells, places: Places) -> CellLoads:
    """One rank's load in each cell."""
    counts = (torch.bincount(partition.cell_of(at), minlength=partition.cell_count) for at in places)
    return CellLoads(*counts)


def _bisected(
    comm: Comm, partition: Bisection, places: Places, options: BalanceOptions, seconds: Tensor
) -> tuple[Partition, int]:
    """New planes, if their gain over the horizon exceeds the cost of moving bodies."""
    points = torch.cat([places.bodies, places.pairs])
    weights = torch.full((len(points),), PAIR_COST, dtype=torch.int64, device=points.device)
    weights[: len(places.bodies)] = 1
    before = _loads(comm, partition, points, weights)
    shares = torch.ones(comm.size, dtype=torch.float64)
    if options.policy == "measured":
        shares = relative_speeds(before.cpu(), seconds)
    after = partition.rebalanced(comm, points, weights, shares.tolist())
    loads = _loads(comm, after, points, weights).cpu() / shares
    moving = comm.sum((after.owner_of(places.bodies) != comm.rank).sum().reshape(1))
    gain = (float((before.cpu() / shares).max()) - float(loads.max())) * options.horizon
    if gain <= options.moving * float(moving) / comm.size or imbalance(loads) >= imbalance(before.cpu() / shares):
        return partition, 0
    return after, int((after.planes != partition.planes).any(dim=1).sum())


def _loads(comm: Comm, partition: Partition, points: Tensor, weights: Tensor) -> Tensor:
    return comm.sum(rank_loads(weights, partition.owner_of(points), comm.size))
