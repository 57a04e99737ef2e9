"""One step of the nanorobot simulation on many ranks: plan, halo, detect, resolve, respond, balance, migrate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from pgccd.detection.broad import BroadPhase
from pgccd.detection.parts import contacts_of_step
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.detect import Detection
from pgccd.distributed.detection.padded_share import ShareCapacity, can_replay, rows_with_slack
from pgccd.distributed.detection.share import Options, OwnSearch, PartEstimates, Share
from pgccd.distributed.halo.capacity import HaloCapacity
from pgccd.distributed.halo.migrate import Census, id_range, migrate
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.partition.rebalancing import Balancer
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.rounds import Fractions, resolve_collisions
from pgccd.runtime.stages import StageClock
from pgccd.runtime.transaction import Replay
from pgccd.sim.captured import CommittedStep, StepGraph
from pgccd.sim.distributed.held_exchange import HeldExchange
from pgccd.sim.distributed.rank_searches import RankSearches, largest_message, padded_state
from pgccd.sim.distributed.reports import Reports
from pgccd.sim.model import Model, RobotState
from pgccd.sim.partners import FIRST_CONTACTS, Partners
from pgccd.sim.replay import SimulationSteps
from pgccd.sim.response import respond
from pgccd.sim.tally import Tally, count_step

# Robots that have left their rank's cells migrate once they exceed the number of ghosts over this (each may be a
# ghost).
_MOST_AWAY = 4


@dataclass(frozen=True)
class CommittedRankStep:
    """A step that was committed on all ranks' devices."""

    made: CommittedStep
    reports: Reports
    stop_requested: bool  #: on any rank

    @property
    def index(self) -> int:
        """Index of the step, from 0."""
        return self.made.index

    @cached_property
    def record(self) -> dict[str, Any]:
        """The line in steps.jsonl, for all ranks; equal on all of them except for times."""
        return self.made.record | {"ranks": self.reports.record(moved_cells=0)}


@dataclass
class RankStep:
    """One rank's part of a step run launch by launch."""

    index: int  #: from 0
    before: RobotState  #: own robots, as planned
    resolution: Fractions  #: of the held robots
    stop_requested: bool  #: on any rank
    find: Callable[[], Detection]  #: computes `detection`
    make_record: Callable[[], dict[str, Any]]  #: computes `record`

    @cached_property
    def detection(self) -> Detection:
        """Contacts of the whole step."""
        return self.find()

    @cached_property
    def record(self) -> dict[str, Any]:
        """The line in steps.jsonl, for all ranks; equal on all of them except for times."""
        return self.make_record()


class DistributedSimulation(SimulationSteps[RankStep]):
    """The robots of a simulation, distributed over ranks; made by `create`, on all ranks together.

    With NCCL, consecutive steps are replays of one CUDA graph per rank, messages included: see `pgccd.sim.replay`.
    Cells and robots change owners only in steps run launch by launch, so robots that leave their rank's cells migrate
    later.

    Example:
        >>> simulation = DistributedSimulation.create(comm, model, partition, starting_share(comm, model))
        >>> simulation.step(0).record["contacts"]
    """

    def __init__(
        self,
        decomposition: Decomposition,
        model: Model,
        state: RobotState,
        expected: Census,
        balance: BalanceOptions,
        options: Options,
        graph: bool,
    ) -> None:
        super().__init__(graph)
        self.comm, self.model, self.options = decomposition.comm, model, options
        self._balancer = Balancer(balance)
        self._plan, self._estimates = RoundPlan(), PartEstimates()
        self._expected = expected
        self._capacity: HaloCapacity | None = None
        self._share_capacity: ShareCapacity | None = None
        self._decomposition, self._stop = decomposition, False
        self._state, self._arrived = state, 0

    @classmethod
    def create(
        cls,
        comm: Comm,
        model: Model,
        partition: Partition,
        state: RobotState,
        balance: BalanceOptions | None = None,
        overlap: bool = True,
        broad_phase: BroadPhase = "auto",
        graph: bool | None = None,
    ) -> DistributedSimulation:
        """Distributes robots over the ranks.

        Args:
            comm: between the ranks.
            model: the rules, the same on all ranks, on this rank's device.
            partition: the same on all ranks.
            state: of any share of the robots; each robot is on exactly one rank.
            balance: options of load balancing.
            broad_phase, overlap: see `Options`.
            graph: whether steps are replayed, the same on all ranks. Default: if messages are sent on a GPU's stream.

        Raises:
            RuntimeError: robots are missing or duplicated.
        """
        query = FIRST_CONTACTS
        options = Options(
            query.report,
            nonzero_toi=query.nonzero_toi,
            initial=query.initial,
            broad_phase=broad_phase,
            overlap=overlap,
        )
        graph = can_replay(comm, model.device) if graph is None else graph
        state = RobotState(**take_rows(state.columns, torch.argsort(state.id)))
        expected = Census.of_range(comm, model.config.robots)
        how = balance or BalanceOptions(), options, graph
        simulation = cls(Decomposition(comm, partition), model, state, expected, *how)
        simulation._migrate(state)
        simulation.verify()
        return simulation

    @property
    def state(self) -> RobotState:
        """State of this rank's own robots after the last step. No step may be enqueued: see `is_ahead`."""
        if self._graph is not None:
            self._take(self._graph)
        return self._state

    @state.setter
    def state(self, state: RobotState) -> None:
        self._state, self._graph = state, None

    @property
    def partition(self) -> Partition:
        """The partition of space; the same on all ranks."""
        return self._decomposition.partition

    @partition.setter
    def partition(self, partition: Partition) -> None:
        self.state, self._decomposition = self.state, Decomposition(self.comm, partition)
        self._capacity = None

    def verify(self) -> None:
        """Checks that every robot is on exactly one rank.

        Raises:
            RuntimeError: robots are lost or duplicated.
        """
        Census.of_ranks(self.comm, self.state.id).require(self._expected)

    def step(self, index: int, stop: bool = False, more: int = 0) -> RankStep | CommittedRankStep:
        """Moves the robots by one step.

        Args:
            index: the same on all ranks, one more than in the previous step.
            stop: whether this rank requests a stop; combined over all ranks by "or".
            more: number of steps that follow before the state or the details of a step are read; the same on all ranks.
                The last of these is not replayed, and after it each robot is on its owner.
        """
        self.comm.guard.activity = f"step {index}"
        self._stop = self._stop or stop
        if self._stop and self._graph is not None:
            self._notes[1] = 1
        made = self._advance(index, more)
        return made if isinstance(made, RankStep) else self._reports_of(made)

    def _launch(self, index: int) -> RankStep:
        clock = StageClock()
        with clock.stage("plan"):
            planned = self.model.plan(self._state, index)
        where = self._decomposition, planned.moving_columns, self._build, self.options, clock
        search = OwnSearch(*where, self._estimates, self._capacity).start()
        # In this order, so that the counts are available before the search with ghosts ends.
        exchange, share = search.of_held(HeldExchange.start), search.with_ghosts()
        self._capacity = HaloCapacity.of(share.held, self._decomposition.neighbours)
        with clock.stage("halo"):
            partners = Partners(self.model, planned.moving_columns, share.held.ghosts, share.pairs)
        after: RobotState = planned

        def conclude(fraction: Tensor) -> Tensor:
            nonlocal after
            fraction = fraction[: len(planned)]
            with clock.stage("respond"):
                after = respond(planned, fraction)
            with clock.stage("hash"):
                counted = count_step(after, fraction, share.held.id, *share.first_contacts())
                return torch.cat([counted, self._host_numbers(share)])

        held = share.parts, len(share.held), partners
        resolved = resolve_collisions(*held, self._plan, conclude, clock, exchange)
        reports = Reports.of(resolved.work, resolved.conclusions)
        resolved.learn()  # so that reading the contacts does not synchronise
        moved_cells = self._balance(index, share, planned, reports, clock)
        with clock.stage("migrate"):
            self._migrate(after)
        clock.stop()
        tally = self._tally(reports)
        if self._wants_graph:
            neighbours = self._decomposition.neighbours
            self._share_capacity = ShareCapacity.after(share, neighbours, exchange.common(neighbours))

        def make_record() -> dict[str, Any]:
            record = tally.record(index, resolved.resolution.rounds, clock)
            return record | {"ranks": reports.record(moved_cells)}

        def find() -> Detection:
            return Detection(share, contacts_of_step(share.parts))

        return RankStep(index, planned, resolved.resolution, bool(reports.stop.any()), find, make_record)

    def _tally(self, reports: Reports) -> Tally:
        """The tally over all ranks. Raises RuntimeError if robots were lost or duplicated."""
        tally = Tally.of(reports.work, reports.counted)
        Census(tally.robots, tally.id_hash).require(self._expected)
        return tally

    def _host_numbers(self, share: Share) -> Tensor:
        numbers = torch.tensor([share.held.ghost_count, self._arrived, int(self._stop), 0])
        return numbers.to(self.model.device, non_blocking=True)

    def _build(self, columns: Columns) -> tuple[Scene, RigidMotion]:
        pose = (columns["position"], columns["orientation"], columns["velocity"], columns["angular_velocity"])
        return self.model.scene(columns["id"]), RigidMotion.from_velocity(*pose, dt=1.0)

    def _balance(self, index: int, share: Share, planned: RobotState, reports: Reports, clock: StageClock) -> int:
        """Rebalances space. Returns the number of cells or planes that moved."""
        if not self._is_balance_due(index, reports):
            return 0
        with clock.stage("balance"):
            found = Detection(share, contacts_of_step(share.parts))
            given = found.places(planned.position), reports.loads, index + 1
            self._decomposition, moved = self._balancer.decide(self._decomposition, *given)
            self._capacity = None if moved else self._capacity
            return moved

    def _is_balance_due(self, index: int, reports: Reports) -> bool:
        return self._balancer.is_due(index + 1, self.comm.size) and not self._balancer.are_level(reports.loads)

    # Methods for replays.

    def _make_graph(self, index: int) -> StepGraph:
        assert self._share_capacity is not None
        self._notes = torch.zeros(2, dtype=torch.int64, device=self.model.device)
        self._graph_decomposition = self._decomposition.copy()
        self.comm.reserve_peer_messages(largest_message(self._share_capacity, self._rounds_to_capture))
        where = self._graph_decomposition, self._share_capacity, self._notes
        searches = RankSearches(*where, self.model, self._build, self.options, self._estimates)
        state = padded_state(self._state, rows_with_slack(len(self._state)))
        rounds = self._rounds_to_capture, self._usual_rounds
        made = self.model, state, index, searches.search, self._plan, *rounds, searches.conclude
        return StepGraph(*made)

    def _begin(self, graph: StepGraph, index: int) -> None:
        self.comm.close_before(graph)
        self._write(graph, index)

    def _is_captured(self, captured: bool) -> bool:
        return not self.comm.any(not captured)

    def _are_others_waiting(self, graph: StepGraph | None) -> bool:
        return self.comm.size > 1 and (graph is None or not graph.has_run)

    def _load(self, graph: StepGraph, index: int) -> bool:
        fits = len(self._state) <= len(graph.state) and self._graph_decomposition.become(self._decomposition)
        if self.comm.any(not fits):
            return False
        self._write(graph, index)
        return True

    def _write(self, graph: StepGraph, index: int) -> None:
        """Writes the state to the graph."""
        self._notes[0], self._notes[1] = self._arrived, int(self._stop)
        graph.load(self._state, index)

    def _take(self, graph: StepGraph) -> None:
        columns = {name: column[: len(self._state)].clone() for name, column in graph.state.columns.items()}
        self._state = RobotState(**columns)

    def _read(self, replay: Replay[CommittedStep], index: int) -> CommittedStep | None:
        with self.comm.guard.waiting("step", for_gpu=self.comm.goes_with_the_stream):
            return replay.read(index)

    def _needs_launch(self, step: CommittedStep, enqueued: int) -> bool:
        reports = Reports.of(step.work, step.conclusions)
        away = bool(_MOST_AWAY * reports.leaving.sum() > reports.ghosts.sum())
        return away or self._is_balance_due(step.index + 1 + enqueued, reports)

    def _reports_of(self, step: CommittedStep) -> CommittedRankStep:
        reports = Reports.of(step.work, step.conclusions)
        self._tally(reports)
        return CommittedRankStep(step, reports, bool(reports.stop.any()))

    def _migrate(self, state: RobotState) -> None:
        """Migrates robots; the state's ids ascend."""
        moved = migrate(self._decomposition, state.columns, state.position)
        self._state, self._arrived = RobotState(**moved.columns), moved.arrived


def starting_share(comm: Comm, model: Model) -> RobotState:
    """An equal share of the robots at the start, for `DistributedSimulation`, which migrates each to the owner of its
    cell.
    """
    first, end = id_range(comm, model.config.robots)
    return model.start(torch.arange(first, end, device=model.device))
