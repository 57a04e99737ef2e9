"""One rank in a loop of steps: its part of space, and what it learned in the last step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch

from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.options import PassEstimates, SearchOptions
from pgccd.distributed.detection.share import Complete, Share, search_share
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.vertices import Vertices
from pgccd.distributed.partition.balance import BalanceOptions, RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.partition.rebalancing import Balancer
from pgccd.runtime.stages import StageClock
from pgccd.search.bodies import MovingBodies

T = TypeVar("T")


class Rank:
    """One rank in a loop of steps. All ranks call every method.

    Args:
        decomposition: of space.
        balance: options of load balancing.
    """

    def __init__(self, decomposition: Decomposition, balance: BalanceOptions) -> None:
        self.comm, self.decomposition = decomposition.comm, decomposition
        self.balancer = Balancer(balance)
        self.estimates = PassEstimates()
        # Numbers of bodies in the last step, and the decomposition then.
        self._sizes: HaloSizes | None = None
        self._sizes_of: Decomposition | None = None

    @property
    def partition(self) -> Partition:
        """The partition of space; the same on all ranks."""
        return self.decomposition.partition

    @partition.setter
    def partition(self, partition: Partition) -> None:
        self.decomposition = Decomposition(self.comm, partition)

    def search(
        self,
        own: Columns,
        bodies: MovingBodies,
        complete: Complete,
        options: SearchOptions,
        clock: StageClock,
        concurrent_work: Callable[[Share], T],
        vertices: Vertices | None = None,
    ) -> tuple[Share, T]:
        """`search_share`, with capacities from the last step where these let a GPU send ghosts without waiting for the
        host.
        """
        is_known = self._sizes_of is self.decomposition and vertices is None
        is_ahead = is_known and sends_ahead(self.comm, bodies.device, options.overlap)
        sizes = self.capacities() if is_ahead else None
        share, made = search_share(
            self.decomposition,
            own,
            bodies,
            complete,
            options,
            self.estimates,
            concurrent_work=concurrent_work,
            sizes=sizes,
            vertices=vertices,
            clock=clock,
        )
        self._sizes, self._sizes_of = share.sizes, self.decomposition
        return share, made

    def learn_common(self, common: list[int]) -> None:
        """Records the numbers of bodies that this rank and each of the `decomposition`'s neighbours held in the last
        step.
        """
        assert self._sizes is not None
        neighbours = self.decomposition.neighbours
        self._sizes = replace(self._sizes.renumbered(neighbours), common=common)

    def capacities(self) -> HaloSizes:
        """Sizes for a step after the last one."""
        assert self._sizes is not None
        return self._sizes.padded(self.decomposition.neighbours)

    def is_balance_due(self, steps_made: int, loads: RankLoads) -> bool:
        """Whether to `balance` after `steps_made` steps."""
        return self.balancer.is_due(steps_made, self.comm.size) and self.balancer.is_worthwhile(loads)

    def balance(self, share: Share, loads: RankLoads, steps_made: int) -> int:
        """Rebalances space. Returns the number of cells or planes that moved.

        Args:
            share: of the last step.
            loads: of all ranks in it.
            steps_made: number of steps made.
        """
        decided = self.balancer.decide(self.decomposition, share.places(), loads, steps_made)
        self.decomposition, moved = decided
        return moved


def sends_ahead(comm: Comm, device: torch.device, overlap: bool) -> bool:
    """Whether ghosts can be sent while own pairs are searched, without waiting for their number."""
    return device.type == "cuda" and overlap and comm.size > 1 and comm.goes_with_the_stream


def can_replay(comm: Comm, device: torch.device) -> bool:
    """Whether a step of a rank can be a CUDA graph, messages included."""
    return device.type == "cuda" and (comm.size == 1 or comm.goes_with_the_stream)
