"""One step of the nanorobot world on many ranks: plan, halo, detect, resolve, respond, balance, migrate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from pgccd.detection.broad import BroadPhase
from pgccd.detection.parts import contacts_of_step
from pgccd.distributed.balance import BalanceOptions, CellLoads, RankLoads, rebalance
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection import Detection, cell_loads
from pgccd.distributed.halo_capacity import HaloCapacity
from pgccd.distributed.migrate import Census, Leaving, migrate
from pgccd.distributed.partition import Partition
from pgccd.distributed.share import Options, OwnSearch, PartEstimates, Share
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.runtime.stages import StageClock
from pgccd.sim.distributed.held_exchange import HeldExchange
from pgccd.sim.distributed.reports import Reports
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import Partners
from pgccd.sim.resolution import Resolution, ResolvedStep, RoundPlan, resolve_collisions
from pgccd.sim.response import respond
from pgccd.sim.tally import Tally, count_step

# Robots made at a time at the start of a world.
_BLOCK_ROBOTS = 1 << 20
# Up to so many ranks, each sends all others its counts of leaving robots together with its tally; with more, those
# affected alone.
_TELLS_MOVES = 64
# Robots that have left stay with their rank as long as there are so many times more ghosts: each may be one.
_MOST_AWAY = 4


@dataclass
class RankStep:
    """One rank's part of a step that was made."""

    index: int  #: from 0
    before: RobotState  #: of the robots owned, as planned
    resolution: Resolution  #: of the robots held
    stop_requested: bool  #: on any rank
    find: Callable[[], Detection]  #: gives `detection`
    make_record: Callable[[], dict[str, Any]]  #: returns `record`

    @cached_property
    def detection(self) -> Detection:
        """Of the whole step."""
        return self.find()

    @cached_property
    def record(self) -> dict[str, Any]:
        """Of the whole model: the line in steps.jsonl, the same on all ranks but for the times."""
        return self.make_record()


@dataclass(frozen=True)
class _Begun:
    """A step whose first work a GPU has been given."""

    index: int
    state: RobotState
    partition: Partition
    planned: RobotState
    search: OwnSearch
    clock: StageClock


class DistributedSimulation:
    """A world's robots, spread over ranks.

    Args:
        comm: between the ranks.
        model: the rules, the same on all ranks, on this rank's device.
        partition: the same on all ranks.
        state: of any share of the robots; all ranks together have each robot once.
        balance: how cells change hands.
        broad_phase, overlap: see `Options`.

    `state` is that of the robots this rank has.

    Example:
        >>> simulation = DistributedSimulation(comm, model, partition, starting_share(comm, model, partition))
        >>> simulation.step(0).record["contacts"]
    """

    def __init__(
        self,
        comm: Comm,
        model: Model,
        partition: Partition,
        state: RobotState,
        balance: BalanceOptions | None = None,
        overlap: bool = True,
        broad_phase: BroadPhase = "auto",
    ) -> None:
        self.comm, self.model, self.partition = comm, model, partition
        self.balance = balance or BalanceOptions()
        # nonzero_toi: robots that part after a contact are free.
        self.options = Options("first", nonzero_toi=True, broad_phase=broad_phase, overlap=overlap)
        self._rounds, self._estimates = RoundPlan(), PartEstimates()
        self._expected = Census.of_range(model.config.robots)
        #: Whether a step that follows at once is begun before the outcome of the one before is known.
        self.begins_early = model.device.type != "cpu" and overlap
        self._begun: _Begun | None = None
        self._capacity: HaloCapacity | None = None
        # In the last step: nothing was about to change hands.
        self._was_calm = False
        self._migrate(RobotState(**take_rows(state.columns, torch.argsort(state.id))))
        self.verify()

    def verify(self) -> None:
        """Checks that every robot is on exactly one rank.

        Raises:
            RuntimeError: some are lost or doubled.
        """
        Census.of_ranks(self.comm, self.state.id).require(self._expected)

    def step(self, index: int, stop: bool = False, more: bool = False) -> RankStep:
        """Moves the robots by one step.

        Args:
            index: the same on all ranks.
            stop: whether this rank was asked to stop; combined over all ranks by "or".
            more: whether the next step follows at once, on all ranks. Then a GPU is given its first work before the
                host knows how this one ends. Robots that have left the cells of their rank stay with it for a while,
                since handing them over would have to be waited for; without more to come each is where it belongs.
        """
        comm = self.comm
        comm.guard.activity = f"step {index}"
        begun = self._take_begun(index)
        planned, clock = begun.planned, begun.clock
        # In this order, so that the host can read how many agree before the search with ghosts is over.
        exchange, share = begun.search.of_held(HeldExchange.start), begun.search.with_ghosts()
        self._capacity = share.held.capacity
        with clock.stage("halo"):
            partners = Partners(self.model, planned.moving_columns, share.held.ghosts, share.pairs)
        after: RobotState = planned
        leaving: Leaving | None = None
        keeps = more and self.begins_early and self._was_calm

        def conclude(fraction: Tensor) -> Tensor:
            nonlocal after, leaving
            fraction = fraction[: len(planned)]
            with clock.stage("respond"):
                after = respond(planned, fraction)
            with clock.stage("hash"):
                counted = count_step(after, fraction, share.held.id, *share.first_contacts())
                leaving = Leaving(comm, self.partition, after.position)
                moves = [leaving.counts] if comm.size <= _TELLS_MOVES else []
                return torch.cat([counted, self._host_numbers(share, stop), leaving.counts.sum()[None], *moves])

        def begin_next(discard: Tensor) -> None:
            self._begun = self._begin(index + 1, after, discard)

        work_ahead = begin_next if keeps else None
        resolved = resolve_collisions(
            share.parts, len(share.held), partners, self._rounds, conclude, clock, exchange, work_ahead
        )
        reports = Reports.of(resolved)
        is_level, moved_cells = self._balance(index, share, resolved, planned, reports, clock)
        with clock.stage("migrate"):
            known = None
            if leaving is not None and moved_cells == 0 and reports.moves.size:
                known = leaving, reports.moves[comm.rank].tolist(), reports.moves[:, comm.rank].tolist()
            if keeps and moved_cells == 0:
                self.state, self._arrived = after, 0
            else:
                self._migrate(after, known)
        clock.stop()
        self._was_calm = is_level and bool(_MOST_AWAY * reports.leaving.sum() <= reports.ghosts.sum())
        if more and self.begins_early and not self._has_begun(index + 1):
            self._begun = self._begin(index + 1, self.state)
        tally = Tally.of(reports.work, reports.counted)
        Census(tally.robots, tally.id_hash).require(self._expected)
        resolved.learn()

        def make_record() -> dict[str, Any]:
            record = tally.record(index, resolved.resolution.rounds, clock)
            return record | {"ranks": reports.record(moved_cells)}

        def find() -> Detection:
            share.lend()
            return Detection(share, contacts_of_step(share.parts))

        return RankStep(index, planned, resolved.resolution, bool(reports.stop.any()), find, make_record)

    def _begin(self, index: int, state: RobotState, discard: Tensor | None = None) -> _Begun:
        """Plans a step, and begins to search pairs of own robots."""
        if self._begun is not None:
            self._begun.search.give_up()
            self._begun = None
        clock = StageClock()
        with clock.stage("plan"):
            planned = self.model.plan(state, index)
        where = self.comm, self.partition, planned.moving_columns, self._build, self.options, clock
        search = OwnSearch(*where, self._estimates, discard, self._capacity)
        return _Begun(index, state, self.partition, planned, search.start(), clock)

    def _has_begun(self, index: int) -> bool:
        """Whether the step has been begun, of these robots and with these owners."""
        begun = self._begun
        return (
            begun is not None
            and begun.index == index
            and begun.state is self.state
            and begun.partition is self.partition
        )

    def _take_begun(self, index: int) -> _Begun:
        begun = self._begun
        if begun is None or not self._has_begun(index):
            return self._begin(index, self.state)
        self._begun = None
        begun.clock.restart()
        return begun

    def _host_numbers(self, share: Share, stop: bool) -> Tensor:
        return torch.tensor([len(share.held), self._arrived, int(stop)]).to(self.model.device, non_blocking=True)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        pose = (columns["position"], columns["orientation"], columns["velocity"], columns["angular_velocity"])
        return self.model.scene(columns["id"]), RigidMotion.from_velocity(*pose, dt=1.0)

    def _balance(
        self,
        index: int,
        share: Share,
        resolved: ResolvedStep,
        planned: RobotState,
        reports: Reports,
        clock: StageClock,
    ) -> tuple[bool, int]:
        """Redistributes the cells. Returns whether there was no need to, and how many moved."""
        if not self.balance.applies(index + 1, self.comm.size):
            return True, 0
        with clock.stage("balance"):
            seconds = reports.seconds()
            loads = RankLoads(reports.robots, reports.worked("pcs"), reports.worked("contacts"), seconds)
            if loads.are_level(self.balance):
                return True, 0
            resolved.learn()  # so that contacts need not be waited for
            seen = cell_loads(self.partition, planned.position, Detection(share, contacts_of_step(share.parts)))
            total = CellLoads.unstacked(self.comm.sum(seen.stacked()))
            shared_out = rebalance(self.partition, total, self.balance, torch.tensor(seconds, dtype=torch.float64))
            moved = int((shared_out.owner != self.partition.owner).sum())
            if moved > 0:
                self.partition, self._capacity = shared_out, None
            return False, moved

    def _migrate(self, state: RobotState, known: tuple[Leaving, list[int], list[int]] | None = None) -> None:
        """Hands robots over; the state's ids ascend."""
        columns, self._arrived = migrate(self.comm, self.partition, state.columns, state.position, known)
        self.state = RobotState(**columns)


def starting_share(comm: Comm, model: Model, partition: Partition) -> RobotState:
    """The robots that start in this rank's cells."""
    parts = []
    for begin in range(0, model.config.robots, _BLOCK_ROBOTS):
        end = min(model.config.robots, begin + _BLOCK_ROBOTS)
        block = model.start(torch.arange(begin, end, device=model.device))
        here = torch.nonzero(partition.owner_of(block.position) == comm.rank)[:, 0]
        parts.append(take_rows(block.columns, here))
    return RobotState(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})
