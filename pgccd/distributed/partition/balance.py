"""Ownership of cells: policies that move cells from loaded ranks to idle ones.

Pure functions of values that are equal on all ranks, so that all make the same decision without communication. The
results of a simulation do not depend on them.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.partition.cells import Cells

Policy = Literal["cost", "measured", "one-cell", "none"]
POLICIES: tuple[str, ...] = get_args(Policy)

# Cost of a potentially colliding pair, in bodies (integrating, sweeping and moving one body).
PAIR_COST = 8
# Limit per step, for all ranks: choosing a cell takes some 50 microseconds, on every rank.
_MOST_MOVES = 4096


@dataclass(frozen=True)
class BalanceOptions:
    """Options of load balancing.

    Attributes:
        policy: "cost": moves several cells per step, by the predicted cost of each. "measured": the same, weighted by
            the measured speed of each rank; the assignment (never the result) then differs from run to run. "one-cell":
            the policy of Du, Liu & Suzumura 2017, 4.2. "none": cells keep their owners.
        threshold: one-cell: minimum difference between the most and the least loaded rank, relative to the most loaded.
        start, goal: cost: balancing starts once the largest load exceeds the mean by the fraction `start`, and ends at
            `goal`.
        moving, horizon: cost: moving a body costs `moving` body-steps; the gain is counted over `horizon` steps.
        deciding: cost: a decision, with its sums over all ranks, costs as much as `deciding` bodies of one rank in one
            step. It is made when the steps since the last decision have lost more than this by imbalance.
        most_moves: cost: maximum number of cells moved in one step, per rank.
        every: steps between decisions.

    Raises:
        TypeError, ValueError: naming the field.
    """

    policy: Policy = "cost"
    threshold: float = 0.1
    start: float = 0.04
    goal: float = 0.02
    moving: float = 4.0
    horizon: int = 32
    deciding: float = 20_000.0
    most_moves: int = 16
    every: int = 1

    def __post_init__(self) -> None:
        arguments.choice(self.policy, "policy", POLICIES)
        for name in ("threshold", "start", "goal", "moving", "deciding"):
            value = arguments.number(getattr(self, name), name, "a finite number >= 0")
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"{name}: expected a finite number >= 0, got {value}")
            object.__setattr__(self, name, value)
        if self.goal > self.start:
            raise ValueError(f"goal: expected at most start = {self.start}, got {self.goal}")
        for name in ("horizon", "most_moves", "every"):
            object.__setattr__(self, name, arguments.integer(getattr(self, name), name, 1, "an integer >= 1"))

    def applies(self, steps_made: int, ranks: int) -> bool:
        """Whether to decide again after `steps_made` steps, among `ranks` ranks."""
        return self.policy != "none" and ranks > 1 and steps_made > 0 and steps_made % self.every == 0


class BackOff:
    """Exponential back-off of decisions. After a decision that moves nothing, the interval doubles. Otherwise loads
    that no move can balance would cost a decision, and a sum over all cells, in every step.

    Example:
        >>> back_off = BackOff()
        >>> back_off.tried(7, moved=0)
        >>> back_off.is_over(8), back_off.is_over(9)
        (False, True)
    """

    _MOST_STEPS = 64

    def __init__(self) -> None:
        self._steps = 0
        self._next = 0

    def is_over(self, step: int) -> bool:
        """Whether a decision may be made in this step."""
        return step >= self._next

    def tried(self, step: int, moved: int) -> None:
        """Records a decision, and how many cells it moved."""
        self._steps = 0 if moved else min(max(1, 2 * self._steps), self._MOST_STEPS)
        self._next = step + 1 + self._steps


@dataclass(frozen=True)
class CellLoads:
    """Load of each cell in the last step; loads of ranks add up."""

    bodies: Tensor  #: (cell_count,) int64: bodies in it
    pairs: Tensor  #: potentially colliding pairs whose reference point is in it
    contacts: Tensor  #: those of the pairs that collide

    @property
    def cost(self) -> Tensor:
        """(cell_count,) int64: predicted cost, in bodies."""
        return self.bodies + PAIR_COST * self.pairs


def rank_loads(load: Tensor, owner: Tensor, ranks: int) -> Tensor:
    """(ranks,): the sum of the loads of each rank's cells."""
    return torch.zeros(ranks, dtype=load.dtype, device=load.device).index_add(0, owner, load)


def imbalance(load: Tensor) -> float:
    """The largest of the loads (ranks,) over their mean; 1.0 is balanced."""
    total = float(load.sum())
    return float(load.max()) * len(load) / total if total > 0.0 else 1.0


@dataclass(frozen=True)
class RankLoads:
    """Loads of each rank in the last step, to check whether to rebalance. Plain numbers, since the check runs in every
    step.
    """

    bodies: Sequence[int]
    pairs: Sequence[int]  #: potentially colliding pairs that it tested
    contacts: Sequence[int]
    seconds: Sequence[float]  #: of work

    @property
    def _cost(self) -> list[int]:
        return [bodies + PAIR_COST * pairs for bodies, pairs in zip(self.bodies, self.pairs, strict=True)]

    @property
    def lost(self) -> float:
        """The largest cost of a rank less the mean, in bodies: what the step has lost by imbalance."""
        cost = self._cost
        return max(cost) - sum(cost) / len(cost)

    def are_level(self, options: BalanceOptions) -> bool:
        """True if no cell would move, whatever the loads of the cells.

        Exact if every body was in a cell of its rank, approximate otherwise.
        """
        if options.policy == "one-cell":
            return _differ_little(self.contacts, options.threshold)
        cost = self._cost
        if options.policy != "measured":
            return _are_even(max(cost), sum(cost) / len(cost), options)
        speed = relative_speeds(torch.tensor(cost), torch.tensor(self.seconds, dtype=torch.float64))
        return _are_even(float((torch.tensor(cost).double() / speed).max()), sum(cost) / float(speed.sum()), options)


def rebalance(partition: Cells, loads: CellLoads, options: BalanceOptions, seconds: Tensor | None = None) -> Cells:
    """The partition of the next step.

    Args:
        partition: of the last step.
        loads: summed over all ranks.
        options: policy and thresholds.
        seconds: (ranks,) of work of each rank; for "measured".

    Example:
        >>> partition = rebalance(partition, loads, BalanceOptions("one-cell"))
    """
    owner = partition.owner.cpu()
    if options.policy == "one-cell":
        moved = one_cell(owner, loads.contacts.cpu(), partition.ranks, options.threshold)
    elif options.policy in ("cost", "measured"):
        speed = torch.ones(partition.ranks, dtype=torch.float64)
        if options.policy == "measured" and seconds is not None:
            speed = relative_speeds(rank_loads(loads.cost.cpu(), owner, partition.ranks), seconds.cpu())
        moved = several_cells(partition, owner, loads.cost.cpu(), loads.bodies.cpu(), speed, options)
    else:
        return partition
    return partition if torch.equal(moved, owner) else partition.with_owner(moved)


def one_cell(owner: Tensor, load: Tensor, ranks: int, threshold: float) -> Tensor:
    """The paper's policy: one cell from the most to the least loaded rank, if they differ by more than the threshold.

    Selects the cell that best balances both without reversing the difference.

    Args:
        owner: (cells,) int64.
        load: (cells,) number of colliding pairs.
        ranks: their number.
        threshold: relative to the larger load.

    Returns:
        (cells,) int64 owners.
    """
    loads = rank_loads(load, owner, ranks)
    if _differ_little(loads.tolist(), threshold):
        return owner
    most, least = int(torch.argmax(loads)), int(torch.argmin(loads))
    difference = int(loads[most] - loads[least])
    # The first of equal ones. A move of the whole difference would only swap the two ranks' loads.
    useful = (owner == most) & (load > 0) & (load < difference)
    if not bool(useful.any()):
        return owner
    off = torch.where(useful, (2 * load - difference).abs(), torch.iinfo(torch.int64).max)
    moved = owner.clone()
    moved[int(torch.argmin(off))] = least
    return moved


def _differ_little(loads: Sequence[int], threshold: float) -> bool:
    most, least = max(loads), min(loads)
    return most - least <= threshold * most


def _are_even(most: float, even: float, options: BalanceOptions) -> bool:
    return even <= 0.0 or most <= (1.0 + options.start) * even


def relative_speeds(cost: Tensor, seconds: Tensor) -> Tensor:
    """(ranks,) float64, mean 1: the speed of each rank, cost (ranks,) per second.

    A rank without work is given the median speed; speeds are clamped to a factor of four about the median.
    """
    busy = (cost > 0) & (seconds > 0.0)
    if not bool(busy.any()):
        return torch.ones(len(cost), dtype=torch.float64)
    speed = cost.double() / seconds.double().clamp(min=1e-9)
    middle = speed[busy].median()
    speed = torch.where(busy, speed, middle).clamp(0.25 * middle, 4.0 * middle)
    return speed / speed.mean()


def several_cells(
    partition: Cells, owner: Tensor, cost: Tensor, bodies: Tensor, speed: Tensor, options: BalanceOptions
) -> Tensor:
    """Moves cells from the most to the least loaded rank, one after the other, until the loads are balanced.

    A cell moves if the reduction of the largest load, over the horizon, exceeds the cost of moving its bodies. Cells
    adjacent to the receiver's are preferred: they keep subdomains, and so halos, compact.

    Args:
        partition: defines which cells are adjacent.
        owner: (cells,) int64.
        cost: (cells,) int64 predicted cost.
        bodies: (cells,) int64 number of bodies.
        speed: (ranks,) float64, relative.
        options: thresholds and cost of moving.

    Returns:
        (cells,) int64 owners.
    """
    ranks = partition.ranks
    table = owner.numpy().copy()
    costs, rates, weights = cost.numpy().astype(np.float64), speed.numpy(), bodies.numpy()
    load = np.bincount(table, costs, minlength=ranks) / rates
    even = costs.sum() / rates.sum()
    if _are_even(float(load.max()), even, options):
        return owner
    grid = table.reshape(partition.grid)
    held: list[list[int]] = [np.flatnonzero(table == rank).tolist() for rank in range(ranks)]
    for _ in range(min(options.most_moves * ranks, _MOST_MOVES)):
        giver, taker = int(np.argmax(load)), int(np.argmin(load))
        if load[giver] <= (1.0 + options.goal) * even:
            break
        cells = np.array(held[giver])
        given, taken = costs[cells] / rates[giver], costs[cells] / rates[taker]
        # The best move minimises the larger of the two loads, which must be less than the giver's present load.
        after = np.maximum(load[giver] - given, load[taker] + taken)
        gain = (load[giver] - after) * options.horizon
        worth = (gain > weights[cells] * options.moving) & (given > 0.0)
        if not worth.any():
            break
        score = np.where(worth, gain - weights[cells] * options.moving, -np.inf)
        near = worth & _share_face_with(grid, cells, taker)
        if near.any() and score[near].max() >= 0.5 * score.max():
            score = np.where(near, score, -np.inf)
        cell = int(cells[np.argmax(score)])  # the first of equal ones
        table[cell] = taker
        held[giver].remove(cell)
        bisect.insort(held[taker], cell)
        load[giver] -= costs[cell] / rates[giver]
        load[taker] += costs[cell] / rates[taker]
    return torch.from_numpy(table)


def _share_face_with(grid: np.ndarray, cells: np.ndarray, rank: int) -> np.ndarray:
    """(len(cells),) bool: whether a cell shares a face with a cell of `rank`."""
    at = np.stack(np.unravel_index(cells, grid.shape), axis=1)
    found = np.zeros(len(cells), dtype=bool)
    for axis in range(3):
        for step in (-1, 1):
            beside = at.copy()
            beside[:, axis] += step
            inside = (beside[:, axis] >= 0) & (beside[:, axis] < grid.shape[axis])
            beside[:, axis] = np.clip(beside[:, axis], 0, grid.shape[axis] - 1)
            found |= inside & (grid[tuple(beside.T)] == rank)
    return found
