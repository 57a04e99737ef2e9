"""Steps of the nanorobot simulation on any number of ranks: plan, halo, detect, resolve, respond, balance, migrate."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.options import RankOptions, SearchOptions
from pgccd.distributed.detection.replica_exchange import ReplicaExchange
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.guard import collective
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.migrate import IdChecksum, id_range, leaving_and_invalid, migrate
from pgccd.distributed.partition.balance import BalanceOptions
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.partition.interface import Partition
from pgccd.distributed.steps.rank import Rank, can_replay
from pgccd.distributed.steps.replayed import RankSteps
from pgccd.geometry.scene import Scene
from pgccd.resolution.counts import GatheredCounts
from pgccd.resolution.listed import ListedSearch
from pgccd.resolution.round_plan import RecentRounds, RoundPlan
from pgccd.resolution.rounds import resolve_collisions
from pgccd.runtime.replayed_steps import GRAPH_SLACK
from pgccd.runtime.stages import StageClock
from pgccd.runtime.transaction import Replay
from pgccd.search.bodies import MovingBodies
from pgccd.search.passes import pairs_of_rounds
from pgccd.search.query import Query
from pgccd.sim.model import Model, RobotState
from pgccd.sim.reports import REPORTED, Reports
from pgccd.sim.response import respond
from pgccd.sim.step import Step
from pgccd.sim.step_graph import CommittedStep, Searches, StepGraph
from pgccd.sim.tally import COUNTED, Tally, count_step

#: Options of the search of the whole step and of every round. nonzero_toi: robots that separate after a contact may
#: move. assume_free: robots start disjoint, and each step ends before the first contact.
FIRST_CONTACTS = Query("first", 0.0, None, True, "assume_free")


class Simulation(RankSteps[Step, CommittedStep, StepGraph]):
    """The robots of a simulation, distributed over any number of ranks, also one; made by `create`, on all ranks
    together.

    On a GPU, with NCCL if there are several ranks, consecutive steps are replays of one CUDA graph per rank, messages
    included. Cells and robots change owners only in steps run eagerly, so robots that leave their rank's cells migrate
    later.

    Attributes:
        comm: between the ranks.
        model: the rules.
        options: of the detection.

    Example:
        >>> simulation = pgccd.sim.Simulation.create(pgccd.distributed.Alone(), model)
        >>> simulation.step(0).record["contacts"]
    """

    def __init__(
        self,
        decomposition: Decomposition,
        model: Model,
        state: RobotState,
        expected: IdChecksum,
        balance: BalanceOptions,
        options: SearchOptions,
        graph: bool,
    ) -> None:
        super().__init__(Rank(decomposition, balance), graph)
        self.comm, self.model, self.options = decomposition.comm, model, options
        self._plan, self._recent = RoundPlan(), RecentRounds()
        self._expected, self._stop = expected, False
        self._state, self._arrived = state, 0
        self._scene: tuple[Tensor, Scene] | None = None
        # What a single rank reports in addition to `count_step`, in the order of `Reports`: it has no ghosts, and no
        # robot leaves.
        self._report = torch.zeros(REPORTED, dtype=torch.int64, device=model.device)
        # Written before a replay: number of robots that arrived since the last one; whether to stop.
        self._notes = self._report[1:3]

    @classmethod
    @collective
    def create(
        cls,
        comm: Comm,
        model: Model,
        partition: Partition | None = None,
        state: RobotState | None = None,
        options: RankOptions | None = None,
        graph: bool | None = None,
    ) -> Simulation:
        """Distributes robots over the ranks.

        Args:
            comm: between the ranks.
            model: the rules, the same on all ranks, on this rank's device.
            partition: the same on all ranks. Default: as the options say.
            state: of any share of the robots; each robot is on exactly one rank. Default: all robots at the start.
            options: of the distribution over ranks, the same on all.
            graph: whether steps are replayed, the same on all ranks. Default: if messages are sent on a GPU's stream.

        Raises:
            RuntimeError: robots are missing or duplicated.
        """
        query, options = FIRST_CONTACTS, options or RankOptions()
        search = SearchOptions(
            query.report,
            nonzero_toi=query.nonzero_toi,
            initial=query.initial,
            broad_phase=options.broad_phase,
            overlap=options.overlap,
            at_any_times=True,
        )
        graph = can_replay(comm, model.device) if graph is None else graph
        partition = starting_partition(comm, model, options) if partition is None else partition
        state = starting_share(comm, model) if state is None else state
        state = RobotState(**take_rows(state.columns, torch.argsort(state.id)))
        expected = IdChecksum.of_range(comm, model.config.robots)
        simulation = cls(Decomposition(comm, partition), model, state, expected, options.balance, search, graph)
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
        return self._rank.partition

    @partition.setter
    def partition(self, partition: Partition) -> None:
        self.state, self._rank.partition = self.state, partition

    @collective
    def verify(self) -> None:
        """Checks that every robot is on exactly one rank.

        Raises:
            RuntimeError: robots are lost or duplicated.
        """
        IdChecksum.of_ranks(self.comm, self.state.id).require(self._expected)

    @collective
    def step(self, index: int, stop: bool = False, more: int = 0) -> Step | CommittedStep:
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
        return self._advance(index, more)

    def _run_eagerly(self, index: int) -> Step:
        clock = StageClock()
        with clock.stage("plan"):
            planned = self.model.plan(self._state, index)
            bodies = MovingBodies.of(self._scene_of(planned.id), self.model.motion(planned), wait=False)
        own = planned.moving_columns

        def start_exchange(share: Share) -> tuple[ReplicaExchange, ListedSearch]:
            return ReplicaExchange.start(share, self._rank.decomposition), rounds_of(share, bodies, own)

        share, (exchange, rounds) = self._rank.search(own, bodies, self._complete, self.options, clock, start_exchange)
        after: RobotState = planned

        def summarise(fraction: Tensor) -> Tensor:
            nonlocal after
            fraction = fraction[: len(planned)]
            with clock.stage("respond"):
                after = respond(planned, fraction)
            with clock.stage("hash"):
                counted = count_step(after, fraction, share.held.id, *share.first_contacts())
                return torch.cat([counted, self._host_numbers(share)])

        given = rounds, len(share.held), self._plan, summarise, clock, exchange
        resolved = resolve_collisions(*given, stopping_round=self.model.config.stopping_round)
        reports = Reports.of(resolved.counts.work, resolved.summaries)
        resolved.learn()  # so that reading the contacts does not synchronise
        moved_cells = 0
        if self._rank.is_balance_due(index + 1, reports.loads):
            with clock.stage("balance"):
                moved_cells = self._rank.balance(share, reports.loads, index + 1)
        with clock.stage("migrate"):
            self._migrate(after)
        clock.stop()
        tally = self._tally(reports)
        if self._wants_graph:
            self._rank.learn_common(exchange.common(self._rank.decomposition.neighbours))

        def make_record() -> dict[str, Any]:
            record = tally.record(index, resolved.resolution.rounds, clock)
            return record | reports.record(moved_cells)

        def find() -> Contacts:
            found = share.contacts
            assert isinstance(found, Contacts)  # of report="first"
            return found

        stop = bool(reports.stop.any())
        return Step(index, planned, resolved.resolution, after, find, make_record, stop, share)

    def _scene_of(self, id: Tensor) -> Scene:
        """The scene of the own robots, kept until robots migrate."""
        if self._scene is None or self._scene[0] is not id:
            self._scene = id, self.model.scene(id)
        return self._scene[1]

    def _tally(self, reports: Reports) -> Tally:
        """The tally over all ranks. Raises RuntimeError if robots were lost or duplicated."""
        tally = Tally.of(reports.work, reports.counted)
        IdChecksum(tally.robots, tally.id_hash).require(self._expected)
        return tally

    def _host_numbers(self, share: Share) -> Tensor:
        numbers = torch.tensor([share.body_count - share.held.own_count, self._arrived, int(self._stop), 0])
        return numbers.to(self.model.device, non_blocking=True)

    def _complete(self, ghosts: Columns) -> Columns:
        """The columns of the scene and motion of ghosts, by the arithmetic of `Model.scene` and `Model.motion`."""
        position = ghosts["position"]
        return {
            "mesh_index": self.model.mesh_index(ghosts["id"]),
            "position_t0": position,
            "position_t1": position + ghosts["velocity"],
            "orientation_t0": ghosts["orientation"],
            "rotation": ghosts["angular_velocity"],
        }

    # Methods for replays.

    @property
    def _columns(self) -> Columns:
        return self._state.columns

    @_columns.setter
    def _columns(self, columns: Columns) -> None:
        self._state = RobotState(**columns)

    def _graph_of(self, index: int, decomposition: Decomposition, sizes: HaloSizes, rows: int) -> StepGraph:
        alone = self.comm.size == 1
        scene = self._scene_of(self._state.id) if alone else None  # of one rank the robots stay the same

        def search(planned: RobotState, discard: Tensor) -> Searches:
            return self._search_padded(planned, discard, decomposition, sizes, scene)

        def summarise(searches: Searches, after: RobotState) -> Tensor:
            """As in `Reports`: numbers of ghosts and of robots that arrived, whether to stop, and number in cells of
            other ranks.
            """
            ghosts = (searches.id[len(after) :] >= 0).sum()[None]
            leaving = leaving_and_invalid(decomposition, after.position, after.id)[:1]
            summary = torch.cat([ghosts, self._notes, leaving])
            self._notes[:1].zero_()
            return summary

        return StepGraph(
            self.model,
            self._state,
            index,
            search,
            self._plan,
            self._recent.to_capture,
            self._recent.usual,
            (lambda *_: self._report) if alone else summarise,
            len(self._state) if alone else rows,
        )

    def _search_padded(
        self,
        planned: RobotState,
        discard: Tensor,
        decomposition: Decomposition,
        sizes: HaloSizes,
        scene: Scene | None,
    ) -> Searches:
        """Enqueues the searches of a planned step, for a graph. Without a `scene` there may be padding."""
        own = planned.moving_columns
        if scene is None:
            scene = self.model.scene(planned.id)
            scene._leave_out(planned.id < 0)
        bodies = MovingBodies.of(scene, self.model.motion(planned), wait=False)

        def start_exchange(share: Share) -> tuple[ReplicaExchange, ListedSearch]:
            exchange = ReplicaExchange.start(share, decomposition, sizes.common, self.comm.peer_messages)
            share.passes[-1].first_contacts()
            return exchange, rounds_of(share, bodies, own)

        share, (exchange, rounds) = search_share(
            decomposition,
            own,
            bodies,
            self._complete,
            self.options,
            self._rank.estimates,
            concurrent_work=start_exchange,
            sizes=sizes,
            synchronises=False,
            discard=discard,
            slack=GRAPH_SLACK,
        )
        failed = [bodies._first_invalid_rows()[-1:]]
        if self.comm.size > 1:
            failed += [share.overflow, exchange.overflow()]
        return Searches(rounds, share.held.id, exchange, failed)

    def _largest_message(self, sizes: HaloSizes) -> int:
        """The first toi of bodies that two ranks hold and one number, or what all ranks gather."""
        gathered = GatheredCounts.width(passes=2) + COUNTED + REPORTED
        return max([2 + self._recent.to_capture, gathered, 1 + max(sizes.common)])

    def _begin(self, graph: StepGraph, index: int) -> None:
        self._write_notes()
        super()._begin(graph, index)

    def _load(self, graph: StepGraph, index: int) -> bool:
        self._write_notes()
        return super()._load(graph, index)

    def _write_notes(self) -> None:
        self._notes[0], self._notes[1] = self._arrived, int(self._stop)

    def _read(self, replay: Replay[Any], index: int) -> CommittedStep | None:
        made: CommittedStep | None = self._wait(replay, index)
        if made is not None:
            self._tally(made.reports)
        return made

    def _note(self, step: Step | CommittedStep) -> None:
        self._recent.note(step.resolution.rounds if isinstance(step, Step) else step.rounds)

    def _is_oversized(self, graph: StepGraph) -> bool:
        return self._recent.need_fewer_than(graph.rounds)

    def _migrate(self, state: RobotState) -> None:
        """Migrates robots; the state's ids ascend."""
        moved = migrate(self._rank.decomposition, state.columns, state.position)
        self._state, self._arrived = RobotState(**moved.columns), moved.arrived


def starting_partition(comm: Comm, model: Model, options: RankOptions, former: str | None = None) -> Partition:
    """The partition of space at the start; `former` is the kind of that in the checkpoint, if there is one."""
    x, y, z = model.half_extent
    return options._cut((-x, -y, -z), (x, y, z)).uniform(comm.size, model.device, options.balance, former)


def starting_share(comm: Comm, model: Model) -> RobotState:
    """An equal share of the robots of `model` at the start on each rank of `comm`, for `Simulation`, which
    migrates each to the owner of its cell.
    """
    first, end = id_range(comm, model.config.robots)
    return model.start(torch.arange(first, end, device=model.device))


def rounds_of(share: Share, bodies: MovingBodies, own: Columns) -> ListedSearch:
    """The rounds of a step of robots. Robots move at constant velocities. Two robots that move by the same fraction are
    not searched: they are at equal times of their whole paths, before the first toi that the search of the whole step
    has certified (docs/explanation/exactness.md, section 12).

    Args:
        share: of the step.
        bodies, own: the own robots, and their columns.
    """

    def by_velocity(moving: MovingBodies, columns: Columns) -> list[Tensor]:
        mesh_index, position, _, *more = moving.tensors
        return [mesh_index, position, columns["velocity"], *more]

    ghosts = None if share.ghosts is None else by_velocity(share.ghosts, share.held.ghosts)
    return ListedSearch(
        share.passes,
        bodies.scene.meshes,
        by_velocity(bodies, own),
        ghosts,
        lambda: pairs_of_rounds(share.passes),
        FIRST_CONTACTS,
        lists_contacts=False,
        skips_equal=True,
        by_velocity=True,
    )
