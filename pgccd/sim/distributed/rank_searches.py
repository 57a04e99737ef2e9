"""The searches of one rank's part of a step, enqueued for a graph."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.distributed.detection.padded_share import ShareCapacity, search_padded_share
from pgccd.distributed.detection.share import Build, Options, PartEstimates
from pgccd.distributed.halo.centres import Centres
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.migrate import count_leaving
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.resolution.counts import GatheredCounts
from pgccd.runtime.replayed_steps import GRAPH_SLACK
from pgccd.sim.captured import Searches, clear_rows
from pgccd.sim.distributed.held_exchange import HeldExchange
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import Partners
from pgccd.sim.tally import COUNTED

# Number of values of `RankSearches.conclude`.
_CONCLUDED = 4


@dataclass(frozen=True)
class RankSearches:
    """`search` and `conclude` of a `StepGraph` on one of many ranks.

    Args:
        decomposition: a copy owned by the graph.
        capacity: of the halo, bodies near ghosts and shared bodies.
        notes: (2,) int64, written before a replay: number of robots that arrived since the last one; whether to stop.
        model, build, options, estimates: of the simulation.
    """

    decomposition: Decomposition
    capacity: ShareCapacity
    notes: Tensor
    model: Model
    build: Build
    options: Options
    estimates: PartEstimates

    def search(self, planned: RobotState, discard: Tensor) -> Searches:
        """Enqueues the searches of a planned step."""
        own, capacity = planned.moving_columns, self.capacity
        asked = self.build, self.options, self.estimates, capacity, discard, GRAPH_SLACK

        def agree(
            held: Held, ghosts: Centres, kept: tuple[float, float], decomposition: Decomposition
        ) -> tuple[HeldExchange, Tensor]:
            peers = decomposition.comm.peer_messages
            exchange = HeldExchange.start(held, ghosts, kept, decomposition, capacity.common, peers)
            return exchange, exchange.overflow()

        share = search_padded_share(self.decomposition, own, *asked, agree, wants_pairs=True)
        exchange, overflow = share.of_held
        assert share.pairs is not None
        partners = Partners(self.model, own, share.held.ghosts, share.pairs)
        return Searches(share.parts, partners, share.held.id, exchange, [share.failed, overflow])

    def conclude(self, searches: Searches, after: RobotState) -> Tensor:
        """(4,) int64 as in `Reports`: numbers of ghosts and of robots that arrived, whether to stop, and number in
        cells of other ranks.
        """
        ghosts = (searches.id[len(after) :] >= 0).sum()[None]
        leaving = count_leaving(self.decomposition, after.position, after.id)
        concluded = torch.cat([ghosts, self.notes, leaving])
        self.notes[:1].zero_()
        return concluded


def padded_state(state: RobotState, rows: int) -> RobotState:
    """The same robots, padded to `rows` rows."""
    padded = {name: column.new_empty((rows, *column.shape[1:])) for name, column in state.columns.items()}
    for name, column in state.columns.items():
        padded[name][: len(state)] = column
    after = RobotState(**padded)
    clear_rows(after, len(state))
    return after


def largest_message(capacity: ShareCapacity, rounds: int) -> int:
    """Size in bytes of the largest message between two ranks that holds no bodies: the first toi of bodies that both
    hold and one number, or what all ranks gather.
    """
    gathered = GatheredCounts.width(parts=2) + COUNTED + _CONCLUDED
    return 8 * max([2 + rounds, gathered, 1 + max(capacity.common)])
