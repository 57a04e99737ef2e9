"""Steps of a `World` as replays of one CUDA graph per rank, with motion and response as functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns, first_row
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.peer_memory import RowsOfRanks
from pgccd.distributed.detection.held_exchange import HeldExchange
from pgccd.distributed.detection.options import SearchOptions
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.guard import collective
from pgccd.distributed.halo.migrate import count_leaving
from pgccd.distributed.halo.sizes import HaloSizes
from pgccd.distributed.launch.agreement import agree_on_step, require_agreement
from pgccd.distributed.launch.code import code_of
from pgccd.distributed.partition.balance import RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.steps.rank import can_replay
from pgccd.distributed.steps.replayed import RankSteps
from pgccd.distributed.world.columns import columns_to_send, motion_facts, scene_of
from pgccd.distributed.world.resolve import listed_search, options_of_resolution
from pgccd.distributed.world.world import World
from pgccd.geometry.columns import bool_column
from pgccd.motion.paths import RigidMotion
from pgccd.motion.validation import LARGEST_COORDINATE
from pgccd.resolution.counts import SearchCounts
from pgccd.resolution.round_plan import RecentRounds
from pgccd.resolution.rounds import Attempt
from pgccd.runtime.replayed_steps import GRAPH_SLACK
from pgccd.runtime.stages import StageClock
from pgccd.runtime.transaction import TransactionGraph
from pgccd.search.bodies import MovingBodies
from pgccd.search.sizes import COUNT_ROWS, busy_nanoseconds, overflow_flags


@dataclass(frozen=True, eq=False)
class Bodies:
    """The own bodies of one rank, as passed to user functions. In a graph, rows with negative ids are padding; their
    values have no effect.

    Attributes:
        id: (N,) int64.
        position: (N, 3) float64, length units, world frame: positions of the origins.
        mesh_index: (N,) int32.
        payload: by name, (N, ...).
        step: (1,) int64: number of steps made.
    """

    id: Tensor
    position: Tensor
    mesh_index: Tensor
    payload: Columns
    step: Tensor


T = TypeVar("T")
#: The motion of the next step.
Motion = Callable[[Bodies], RigidMotion]
#: From the bodies at t0, their motion, and the first toi of each (N,), inf without a contact, 0 throughout if the
#: search of any rank was incomplete: the position at the end of the step as "position", and other values of the payload
#: by name.
Response = Callable[[Bodies, RigidMotion, Tensor], Columns]
#: The bodies (N,) bool that may be stopped in the next step.
Movable = Callable[[Bodies], Tensor]


@dataclass(frozen=True)
class WorldStep:
    """Counts of one step, summed over ranks.

    Attributes:
        pcs: potentially colliding pairs.
        contacts: pairs that collide.
        replayed: whether the step was a replay of a graph.
        rounds: detections in rounds, in a step that is resolved.
    """

    pcs: int
    contacts: int
    replayed: bool
    rounds: int = 0


@dataclass(frozen=True)
class _Committed:
    """A step that was committed on all ranks: see `CommittedByRanks`."""

    index: int
    found: WorldStep
    loads: RankLoads
    leaving: int
    ghosts: int


class CapturedWorld(RankSteps[WorldStep, _Committed, "_WorldGraph"]):
    """A loop of steps of a `World`: motion, detection, response.

    On GPUs (over NCCL, if there are several) a step is the replay of one CUDA graph per rank, with messages and both
    functions, and the host waits only for the record of the previous step. A step that exceeds a capacity changes
    nothing, and is repeated eagerly; so are the last step of `run` and steps in which bodies migrate.
    Elsewhere all steps run eagerly. The results are bitwise equal. In a step that will be repeated, or for
    which an error will be raised, contacts may be missing on any rank: `response` is then passed a first toi of 0 for
    every body of every rank.

    Args:
        world: with report="first".
        motion: called with the rank's `Bodies`. On a GPU it may only enqueue work, see `torch.cuda.graph`.
        response: called with the `Bodies`, the motion, and the first toi of each (N,) float64; returns new values by
            name: "position" (N, 3) and any payload. It may only enqueue work, too. All ranks call it in each step, so
            it may reduce values over them.
        graph: whether steps are replayed, the same on all ranks. Default: if possible.
        resolve: resolves each step, see `World.step`: `response` is passed the shortened motion, and instead of the
            first toi the fraction (N,) float64 of its path that each body moves; 1 where nothing stopped it. The
            shortened motion is not tested again: its lists would not be read. Steps run eagerly if the world's path is
            "linear", and after one in which four times as many pairs may meet at any two times as at equal times.
        movable: with `resolve`, called with the `Bodies`; returns (N,) bool, the bodies that may be stopped. Default:
            all.

    Attributes:
        comm: between the ranks.

    Raises:
        TypeError, ValueError: naming the argument; `graph` is True with `resolve` and path="linear".

    Example:
        >>> def motion(bodies):
        ...     return pgccd.RigidMotion.from_velocity(
        ...         bodies.position, bodies.payload["q"], bodies.payload["v"], bodies.payload["w"], dt=0.1
        ...     )
        >>> def response(bodies, motion, first_toi):  # all bodies stop short of the first contact of the scene
        ...     fraction = comm.min(torch.cat([0.9 * first_toi, first_toi.new_ones(1)]).amin()[None])
        ...     position, orientation = motion.at(fraction)
        ...     sign = torch.where(first_toi < 2.0 * fraction, -1.0, 1.0)[:, None]
        ...     at = bodies.payload
        ...     return {"position": position, "q": orientation, "v": sign * at["v"], "w": sign * at["w"]}
        >>> steps = pgccd.distributed.CapturedWorld(world, motion, response).run(100)
    """

    def __init__(
        self,
        world: World[Contacts],
        motion: Motion,
        response: Response,
        graph: bool | None = None,
        *,
        resolve: bool = False,
        movable: Movable | None = None,
    ) -> None:
        if not isinstance(world, World):
            raise TypeError(f"world: expected a pgccd.distributed.World, got {arguments.describe(world)}")
        if world.options.report != "first":
            raise ValueError(f'world: expected one with report="first", this has {world.options.report!r}')
        for name, function in (("motion", motion), ("response", response)):
            if not callable(function):
                raise TypeError(f"{name}: expected a function, got {arguments.describe(function)}")
        if world.vertex_payload:
            raise ValueError("world: expected one without vertex_payload: its motion is rigid")
        if not arguments.flag(resolve, "resolve") and movable is not None:
            raise ValueError("movable: can only be given with resolve=True")
        if movable is not None and not callable(movable):
            raise TypeError(f"movable: expected a function, got {arguments.describe(movable)}")
        may_replay = not resolve or world.path == "rigid"
        if graph and not may_replay:
            raise ValueError("graph: steps on linear paths that are resolved cannot be replayed; leave it out")
        graph = may_replay and can_replay(world.comm, world.id.device) if graph is None else graph
        super().__init__(world._rank, graph)
        self.comm = world.comm
        self._world, self._motion, self._response = world, motion, response
        self._resolve, self._movable = resolve, movable
        self._recent = RecentRounds()

    @collective
    def run(self, steps: int) -> list[WorldStep]:
        """Runs steps. Afterwards `world` is in the final state, and each body is on its owner.

        Args:
            steps: their number, the same on all ranks.

        Raises:
            TypeError, ValueError: as `World.step` and `World.move` raise for the results of the functions; or ranks
                have different `steps`, `graph`, or code of a function.
        """
        steps = arguments.integer(steps, "steps", 0, "a number of steps >= 0")
        world, found = self._world, []
        functions = {"motion": code_of(self._motion), "response": code_of(self._response)}
        if self._movable is not None:
            functions["movable"] = code_of(self._movable)
        choices = {"steps": steps, "graph": self._wants_graph, "resolve": self._resolve}
        require_agreement(world.comm, choices | functions)
        world.comm.guard.activity = "step"
        if self._graph is not None and not self._load(self._graph, world.steps_made):
            self._graph = None
        for more in reversed(range(steps)):
            made = self._advance(world.steps_made, more)
            if isinstance(made, _Committed):
                world.steps_made, made = world.steps_made + 1, made.found
            found.append(made)
        return found

    @property
    def is_graph(self) -> bool:
        """Whether there is a graph of the next step."""
        return self._graph is not None

    def _run_eagerly(self, index: int) -> WorldStep:
        world = self._world
        bodies = _bodies(world.columns, torch.full((1,), index, device=world.id.device))
        motion, rounds = self._motion(bodies), 0
        _require_rigid(motion)
        if self._resolve:
            motion, answer, rounds = self._resolve_eagerly(bodies, motion)
        else:
            answer = world.first_toi(world.step(motion))
        assert world.found is not None
        counts = torch.tensor([len(world.found.pairs), len(world.found.contacts)])
        pcs, contacts = world.comm.sum(counts).tolist()
        world.move(**_with_position(self._response(bodies, motion, answer)))
        return WorldStep(pcs, contacts, replayed=False, rounds=rounds)

    def _resolve_eagerly(self, bodies: Bodies, motion: RigidMotion) -> tuple[RigidMotion, Tensor, int]:
        """The shortened motion, the fraction (N,) that each body moves, and the number of rounds."""
        world, fixed = self._world, None

        def settings() -> dict[str, Any]:
            nonlocal fixed
            fixed = _fixed(self._movable, bodies)
            return motion_facts(motion, world.path, world._meshes, world.mesh_index)

        agree_on_step(world.comm, settings)
        found = world._fractions(motion, fixed, self._wants_graph)
        return motion.shortened(found.fraction), found.fraction, found.rounds

    def _fits(self, graph: _WorldGraph) -> bool:
        # Bodies that were added may have brought columns; all ranks have the same.
        is_same = graph.columns.keys() == self._columns.keys() and graph.excluded is self._world.options.excluded
        return is_same and super()._fits(graph)

    def _try_to_capture(self, index: int) -> _WorldGraph | None:
        world = self._world
        if self._resolve and not world._resolution_plan.lists:
            return None
        # Without bodies there is none whose columns could be padding.
        return super()._try_to_capture(index) if world.census.count else None

    def _graph_of(self, index: int, decomposition: Decomposition, sizes: HaloSizes, rows: int) -> _WorldGraph:
        world = self._world
        padding = _any_body(world.comm, world.columns)
        padding["id"].fill_(-1)
        given = world, self._motion, self._response, decomposition, sizes, index, padding, rows
        if not self._resolve:
            return _WorldGraph(*given)
        return _ResolvingGraph(*given, self._movable, self._recent)

    def _largest_message(self, sizes: HaloSizes) -> int:
        changes, common = (1 + self._recent.to_capture, sizes.common) if self._resolve else (0, [])
        return 1 + max(4 + changes + 2 * len(COUNT_ROWS), *sizes.sent, *sizes.received, *common)

    def _note(self, step: WorldStep | _Committed) -> None:
        self._recent.note((step.found if isinstance(step, _Committed) else step).rounds)

    def _is_oversized(self, graph: _WorldGraph) -> bool:
        return self._resolve and self._recent.need_fewer_than(graph.rounds)

    @property
    def _columns(self) -> Columns:
        return self._world.columns

    @_columns.setter
    def _columns(self, columns: Columns) -> None:
        self._world.columns = columns


@dataclass(frozen=True, eq=False)
class _Answer:
    """What the response to a step is passed, and what its record holds, in a graph."""

    share: Share
    motion: RigidMotion
    values: Tensor  #: (N,) float64: the first toi of each own body, or the fraction that it moves
    incomplete: Tensor  #: (1,) int64: whether the search of any rank was incomplete
    changes: Tensor  #: int64, of this rank, in rounds
    counts: list[Tensor]  #: (22,) int64 of each pass


class _WorldGraph(TransactionGraph[_Committed]):
    """One rank's part of a step. It is committed if no rank exceeded a capacity and all poses are valid.

    Args:
        world: the graph is captured for its state.
        motion, response: of the user.
        decomposition: a copy owned by the graph.
        sizes: of the halo.
        index: of the next step.
        padding: columns of a body, so that the user's functions get valid values in unused rows, with id -1.
        rows: number of rows for own bodies.
    """

    def __init__(
        self,
        world: World[Contacts],
        motion: Motion,
        response: Response,
        decomposition: Decomposition,
        sizes: HaloSizes,
        index: int,
        padding: Columns,
        rows: int,
    ) -> None:
        super().__init__(world.columns, index, padding, rows)
        self._world, self._motion, self._response = world, motion, response
        self.excluded = world.options.excluded
        self._decomposition, self._sizes = decomposition, sizes

    rounds = 0  #: of resolution

    def _step(self) -> Tensor:
        """(ranks, 4 + changes + 22 * passes) int64: failure flag; numbers of own bodies, ghosts, and leaving bodies;
        `changes` of rounds; counts.
        """
        world, columns = self._world, self.columns
        comm, id = world.comm, columns["id"]
        bodies = _bodies(columns, self._index)
        motion = self._motion(bodies)
        _require_rigid(motion)
        scene = scene_of(world._meshes, columns)
        scene._leave_out(id < 0)
        moving = MovingBodies.of(scene, motion, wait=False)
        answer = self._answer(bodies, moving, motion)
        new = _with_position(self._response(bodies, answer.motion, answer.values))
        is_body = id >= 0
        leaving = count_leaving(self._decomposition, new["position"].contiguous(), id)
        is_valid = ((new["position"].abs() <= LARGEST_COORDINATE).all(dim=1) | ~is_body).all()
        failed = answer.incomplete | ~is_valid
        owned, ghosts = is_body.sum()[None], (answer.share.held.ghosts["id"] >= 0).sum()[None]
        mine = torch.cat([failed, owned, ghosts, leaving, answer.changes, *answer.counts])
        record = comm.all_gather(mine) if comm.peer_messages is None else comm.peer_messages.gather(mine)
        self._failed.copy_(record[:, 0].amax(dim=0, keepdim=True).clamp(max=1))
        self._index += 1 - self._failed
        commits = is_body & (self._failed == 0)
        # All values are computed before any is written: a response may return columns of the state under other names.
        written = []
        for name, values in new.items():
            column = columns[name if name == "position" else "." + name]
            is_new = commits.view(-1, *[1] * (column.dim() - 1))
            written.append((column, torch.where(is_new, values, column)))
        for column, values in written:
            column.copy_(values)
        return record

    def _answer(self, bodies: Bodies, moving: MovingBodies, motion: RigidMotion) -> _Answer:
        """Enqueues the search of the step."""
        # The rows of contacts with ghosts are found concurrently with the search of own pairs.
        share, _ = self._search(moving, {}, self._world.options, lambda share: share.passes[-1].first_contacts())
        counts = [search_pass.counts() for search_pass in share.passes]
        incomplete = self._incomplete(moving, share, [flag for of_pass in counts for flag in overflow_flags(of_pass)])
        first, incomplete = _first_toi(share, self._world.comm, incomplete)
        return _Answer(share, motion, first, incomplete, incomplete[:0], counts)

    def _search(
        self, moving: MovingBodies, marks: Columns, options: SearchOptions, beside: Callable[[Share], T]
    ) -> tuple[Share, T]:
        """`search_share` in the graph's capacities; `marks` (N, ...) are sent with ghosts."""
        return search_share(
            self._decomposition,
            columns_to_send(self.columns["id"], moving) | marks,
            moving,
            lambda ghosts: ghosts,
            options,
            self._world._rank.estimates,
            beside=beside,
            sizes=self._sizes,
            synchronises=False,
            discard=self._failed,
            slack=GRAPH_SLACK,
        )

    def _incomplete(self, moving: MovingBodies, share: Share, flags: list[Tensor]) -> Tensor:
        """(1,) int64: nonzero if this rank's search may have missed contacts: `flags` (1,), more bodies than fit, or an
        invalid pose.
        """
        return torch.cat([self._failed, share.overflow, moving._first_invalid_rows()[-1:], *flags]).sum().reshape(1)

    def _committed(self, index: int, record: NDArray[np.int64], seconds: float) -> _Committed:
        owned, ghosts, leaving = record[:, 1:4].T
        begin = 5 + self.rounds if self.rounds else 4
        rounds = int(np.argmin(record[:, 4:begin].max(axis=0))) if self.rounds else 0
        counts = record[:, begin:].reshape(len(record), -1, len(COUNT_ROWS))
        pcs, contacts = (counts[:, :, COUNT_ROWS[name]].sum(axis=1) for name in ("pairs_written", "contacts"))
        spent = (1e-9 * busy_nanoseconds(counts)).tolist()
        loads = RankLoads(owned.tolist(), pcs.tolist(), contacts.tolist(), spent)
        found = WorldStep(int(pcs.sum()), int(contacts.sum()), replayed=True, rounds=rounds)
        return _Committed(index, found, loads, int(leaving.sum()), int(ghosts.sum()))


class _ResolvingGraph(_WorldGraph):
    """The same of a step that is resolved. It is not committed if more rounds are needed than were captured.

    Args:
        movable: of the user.
        recent: numbers of rounds in recent steps.
    """

    def __init__(self, *given: Any) -> None:
        *of_step, movable, recent = given
        super().__init__(*of_step)
        self._movable = movable
        self.rounds, self._usual_rounds = recent.to_capture, recent.usual

    def _answer(self, bodies: Bodies, moving: MovingBodies, motion: RigidMotion) -> _Answer:
        world = self._world
        comm, plan, options = world.comm, world._resolution_plan, options_of_resolution(world.options, lists=True)
        fixed = _fixed(self._movable, bodies)
        marks = {} if fixed is None else {"fixed": fixed}

        def beside(share: Share) -> HeldExchange:
            exchange = HeldExchange.start(share, self._decomposition, self._sizes.common, comm.peer_messages)
            share.passes[-1].first_contacts()
            return exchange

        share, exchange = self._search(moving.stoppable(), marks, options, beside)
        if fixed is not None and share.ghosts is not None:
            fixed = torch.cat([fixed, share.held.ghosts["fixed"]])
        rounds = listed_search(share, lists_contacts=options.query.tests_start)
        attempt = Attempt(rounds, len(share.held), plan.rounds, exchange, StageClock(), fixed)
        changes, of_rounds = attempt.run_replay(self.rounds, self._usual_rounds)
        counts = [search_pass.counts() for search_pass in share.passes]
        flags = [*SearchCounts(counts, of_rounds).overflow(), changes[-1:]]
        if comm.size > 1:
            flags.append(exchange.overflow())
        incomplete = self._incomplete(moving, share, flags)
        incomplete = exchange.gather(incomplete).amax(dim=0).clamp(max=1)
        fraction = attempt.fraction[: share.held.own_count].masked_fill(incomplete != 0, 0.0)
        return _Answer(share, motion.shortened(fraction), fraction, incomplete, changes, counts)


def _fixed(movable: Movable | None, bodies: Bodies) -> Tensor | None:
    """(N,) bool: the bodies that may not be stopped; None: none."""
    if movable is None:
        return None
    return bool_column(movable(bodies), "movable", len(bodies.id), bodies.id.device) == 0


def _first_toi(share: Share, comm: Comm, incomplete: Tensor) -> tuple[Tensor, Tensor]:
    """The first toi of each own body, (N,) float64, over all ranks that hold it; and whether the search of any rank was
    incomplete, (1,) int64 0 or 1. All toi are 0 then: contacts lost on one rank may be those of others' bodies.

    Args:
        share: of this rank.
        comm: between the ranks.
        incomplete: (1,) int64, nonzero if the search of this rank may have missed contacts.
    """
    held, own_count, peers = share.held, share.held.own_count, comm.peer_messages
    pairs, toi = share.first_contacts()
    first = toi.new_full((len(held) + 1,), torch.inf)  # the last row is for padding
    _lower(first, pairs.reshape(-1), toi.repeat_interleave(2))
    neighbours = held.route.neighbours
    if peers is not None:
        ghosts = torch.arange(own_count, len(held), device=first.device)
        sent = RowsOfRanks(ghosts, neighbours.counts_of_ranks(held.route.received))
        received = RowsOfRanks(held.route.rows, neighbours.counts_of_ranks(held.route.sent))
        anywhere = torch.zeros_like(incomplete)
        peers.lower(first, sent, received, incomplete, anywhere)
    else:
        if neighbours.comm.size > 1:
            answer = held.route.back({"toi": first[own_count:-1]}).wait()["toi"]
            _lower(first, held.route.rows, answer)
        anywhere = comm.all_gather(incomplete).amax(dim=0).clamp(max=1)
    return first[:own_count].masked_fill(anywhere != 0, 0.0), anywhere


def _lower(first: Tensor, rows: Tensor, toi: Tensor) -> None:
    """Lowers the given rows (K,), -1 for padding, to toi (K,)."""
    first.scatter_reduce_(0, torch.where(rows < 0, len(first) - 1, rows), toi, "amin")


def _bodies(columns: Columns, step: Tensor) -> Bodies:
    payload = {name[1:]: column for name, column in columns.items() if name.startswith(".")}
    return Bodies(columns["id"], columns["position"], columns["mesh_index"], payload, step)


def _require_rigid(motion: RigidMotion) -> None:
    if not isinstance(motion, RigidMotion):
        raise TypeError(f"motion: expected a pgccd.RigidMotion to be returned, got {arguments.describe(motion)}")


def _with_position(new: Columns) -> Columns:
    if not isinstance(new, dict) or "position" not in new:
        raise TypeError(f'response: expected tensors by name, "position" among them, got {arguments.describe(new)}')
    return new


def _any_body(comm: Comm, columns: Columns) -> Columns:
    """One row of each column: a body of the first rank that has one."""
    some = {name: column[:1] for name, column in columns.items()}
    return first_row(comm, torch.full_like(some["id"], comm.rank)[:, None], some)
