"""One step of the model as a CUDA graph. It is committed if no rank exceeded a capacity, all collisions are resolved
and the poses are valid; otherwise `pgccd.sim.Simulation` runs it eagerly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.distributed.partition.balance import RankLoads
from pgccd.resolution.counts import GatheredCounts, Rows, SearchCounts
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Attempt, Exchange, RoundSearch
from pgccd.runtime.sizes import Counts
from pgccd.runtime.stages import StageClock
from pgccd.runtime.transaction import TransactionGraph
from pgccd.search.passes import first_contacts_of
from pgccd.sim.model import PLANNED, Model, RobotState
from pgccd.sim.reports import Reports
from pgccd.sim.tally import Tally, count_step


@dataclass(frozen=True)
class Searches:
    """The searches of one rank in a step, enqueued in fixed capacities."""

    rounds: RoundSearch
    id: Tensor  #: (H,) int64 ids of the held robots, those of the state first; negative for padding
    exchange: Exchange
    failed: Sequence[Tensor]  #: (1,) int64, nonzero if poses are invalid or a capacity between ranks was exceeded


#: Enqueues the searches of a planned step, given (1,) int64 on the device, nonzero if their results will be discarded.
Search = Callable[[RobotState, Tensor], Searches]
#: From a step's searches and the state after it: (k,) int64 values to send to all ranks.
Summarise = Callable[[Searches, RobotState], Tensor]


@dataclass
class CommittedStep:
    """A step that was replayed, and committed on the devices of all ranks.

    Attributes:
        index: of the step, from 0.
        rounds: of collision resolution.
        seconds: on the device.
        rank: this rank.
        counts: of the searches of all ranks.
        summaries: (ranks, 10) int64: from `count_step`, then from `StepGraph.summarise`.
    """

    index: int
    rounds: int
    seconds: float
    rank: int
    counts: GatheredCounts
    summaries: Rows

    @cached_property
    def reports(self) -> Reports:
        """Values of all ranks."""
        return Reports.of(self.counts.work, self.summaries)

    @property
    def stop_requested(self) -> bool:
        """Whether the run was asked to stop, on any rank."""
        return bool(self.reports.stop.any())

    @property
    def loads(self) -> RankLoads:
        """The ranks' loads, for balancing."""
        return self.reports.loads

    @property
    def ghosts(self) -> int:
        """Number of ghosts, over all ranks."""
        return int(self.reports.ghosts.sum())

    @property
    def leaving(self) -> int:
        """Number of robots in cells of other ranks, over all ranks."""
        return int(self.reports.leaving.sum())

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its line in steps.jsonl; of all ranks, and equal on all of them except for times. With several ranks the
        stages of detection are those of own pairs; the stage "halo" is the time until the search of ghosts' pairs,
        concurrent with it, ends too. "respond" is everything else.
        """
        own, *others = [Counts.of(numbers) for numbers in self.counts.of_passes[self.rank].tolist()]
        stages = own.seconds
        if others:
            ended = max(other.narrow_ended for other in others)
            stages = {"halo": 1e-9 * max(0, ended - own.narrow_ended)} | stages
        respond = max(0.0, self.seconds - sum(stages.values()))
        clock = StageClock.of(stages | {"respond": respond}, self.seconds)
        tally = Tally.of(self.reports.work, self.reports.counted)
        return tally.record(self.index, self.rounds, clock) | self.reports.record(moved_cells=0)


class StepGraph(TransactionGraph[CommittedStep]):
    """One step as a CUDA graph, from a state in fixed memory to the next one. Each rank has a graph, which includes the
    messages between them.

    Args:
        model: the rules.
        state: of the robots; copied.
        index: number of the next step.
        search: enqueues the searches of a planned step.
        plan: capacities of rounds.
        rounds: number of rounds of collision resolution.
        usual_rounds: of these, how many every replay runs; see `Attempt.run_replay`.
        summarise: values to exchange besides those of `count_step`, in the order of `Reports`.
        rows: number of rows for robots; those with negative ids are padding.
    """

    def __init__(
        self,
        model: Model,
        state: RobotState,
        index: int,
        search: Search,
        plan: RoundPlan,
        rounds: int,
        usual_rounds: int,
        summarise: Summarise,
        rows: int,
    ) -> None:
        super().__init__(state.columns, index, _padding(state), rows)
        self._model, self._search, self._plan, self.rounds = model, search, plan, rounds
        self._usual_rounds = usual_rounds
        self._summarise = summarise
        self._passes, self._rank = 1, 0

    @property
    def state(self) -> RobotState:
        """The state in fixed memory."""
        return RobotState(**self.columns)

    def _step(self) -> Tensor:
        """plan, detect, resolve, commit, count. Returns the record, one row per rank: failure flag, changes of rounds,
        `SearchCounts.values`, summaries.
        """
        model, state = self._model, self.state
        planned = model.plan(state, self._index)
        searches = self._search(planned, self._failed)
        exchange, robots = searches.exchange, len(searches.id)
        attempt = Attempt(
            searches.rounds,
            robots,
            self._plan,
            exchange,
            StageClock(),
            stopping_round=model.config.stopping_round,
        )
        # If the last of the changes is nonzero, more rounds are needed.
        changes, of_rounds = attempt.run_replay(self.rounds, self._usual_rounds)
        counts = SearchCounts([search_pass.counts() for search_pass in searches.rounds.passes], of_rounds)
        failed = torch.cat([self._failed, changes[-1:], *counts.overflow(), *searches.failed]).sum().reshape(1)
        outcome = exchange.gather(torch.cat([failed, changes]))
        anywhere = failed if exchange.ranks == 1 else outcome[:, 0].amax(dim=0, keepdim=True)
        torch.clamp(anywhere, max=1, out=self._failed)
        fraction = attempt.fraction[: len(state)]
        plan = [getattr(planned, name) for name in PLANNED]
        ops.simulate_commit(list(state.columns.values()), plan, fraction, self._failed)
        counted = count_step(state, fraction, searches.id, *first_contacts_of(searches.rounds.passes))
        summary = [counted, self._summarise(searches, state)]
        self._index += 1 - self._failed
        self._passes, self._rank = len(searches.rounds.passes), exchange.rank
        values = [*counts.values(), *summary]
        if exchange.ranks == 1:
            return torch.cat([outcome[0], *values])[None]
        return torch.cat([outcome, exchange.gather(torch.cat(values))], dim=1)

    def _committed(self, index: int, record: NDArray[np.int64], seconds: float) -> CommittedStep:
        begin = 2 + self.rounds
        end = begin + GatheredCounts.width(self._passes)
        rounds = int(np.argmin(record[:, 1:begin].max(axis=0)))
        counts = GatheredCounts.of(record[:, begin:end])
        return CommittedStep(index, rounds, seconds, self._rank, counts, record[:, end:])


def _padding(like: RobotState) -> dict[str, Tensor]:
    """A row of padding: a robot with a negative id, at rest in a valid pose."""
    row = like.map(lambda column: column.new_zeros((1, *column.shape[1:])))
    for column in (row.id, row.target, row.stay_until):
        column.fill_(-1)
    row.orientation[:, 0] = 1.0
    return row.columns
