"""Steps of a `World` as replays of one CUDA graph per rank, with motion and response as functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.exchange import Columns, first_row
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.peer_memory import RowsOfRanks
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.guard import collective
from pgccd.distributed.halo.migrate import count_leaving
from pgccd.distributed.halo.sizes import HaloSizes
from pgccd.distributed.launch.agreement import require_agreement
from pgccd.distributed.launch.code import code_of
from pgccd.distributed.partition.balance import RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.steps.rank import can_replay
from pgccd.distributed.steps.replayed import RankSteps
from pgccd.distributed.world.columns import columns_to_send, scene_of
from pgccd.distributed.world.world import World
from pgccd.motion.paths import RigidMotion
from pgccd.motion.validation import LARGEST_COORDINATE
from pgccd.runtime.replayed_steps import GRAPH_SLACK
from pgccd.runtime.sizes import COUNT_ROWS, busy_nanoseconds, overflow_flags
from pgccd.runtime.transaction import TransactionGraph
from pgccd.search.bodies import MovingBodies


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
    """

    pcs: int
    contacts: int
    replayed: bool


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
            first toi the fraction (N,) float64 of its path that each body moves; 1 where nothing stopped it. Such steps
            run eagerly.
        movable: with `resolve`, called with the `Bodies`; returns (N,) bool, the bodies that may be stopped. Default:
            all.

    Attributes:
        comm: between the ranks.

    Raises:
        TypeError, ValueError: naming the argument; `graph` is True with `resolve`.

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
        world: World,
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
        if resolve and graph:
            raise ValueError("graph: steps that are resolved cannot be replayed; leave it out, they run eagerly")
        graph = not resolve and can_replay(world.comm, world.id.device) if graph is None else graph
        super().__init__(world._rank, graph)
        self.comm = world.comm
        self._world, self._motion, self._response = world, motion, response
        self._resolve, self._movable = resolve, movable

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
        motion = self._motion(bodies)
        _require_rigid(motion)
        if self._resolve:
            movable = None if self._movable is None else self._movable(bodies)
            resolved = world.step(motion, resolve=True, movable=movable)
            motion, answer = resolved.motion, resolved.fraction
        else:
            answer = world.first_toi(world.step(motion))
        assert world.found is not None
        counts = torch.tensor([len(world.found.pairs), len(world.found.contacts)])
        pcs, contacts = world.comm.sum(counts).tolist()
        world.move(**_with_position(self._response(bodies, motion, answer)))
        return WorldStep(pcs, contacts, replayed=False)

    def _fits(self, graph: _WorldGraph) -> bool:
        # Bodies that were added may have brought columns; all ranks have the same.
        is_same = graph.columns.keys() == self._columns.keys() and graph.excluded is self._world.options.excluded
        return is_same and super()._fits(graph)

    def _try_to_capture(self, index: int) -> _WorldGraph | None:
        # There is no body whose columns could be padding.
        return super()._try_to_capture(index) if self._world.census.count else None

    def _graph_of(self, index: int, decomposition: Decomposition, sizes: HaloSizes, rows: int) -> _WorldGraph:
        world = self._world
        padding = _any_body(world.comm, world.columns)
        padding["id"].fill_(-1)
        return _WorldGraph(world, self._motion, self._response, decomposition, sizes, index, padding, rows)

    def _largest_message(self, sizes: HaloSizes) -> int:
        return 1 + max(4 + 2 * len(COUNT_ROWS), *sizes.sent, *sizes.received)

    @property
    def _columns(self) -> Columns:
        return self._world.columns

    @_columns.setter
    def _columns(self, columns: Columns) -> None:
        self._world.columns = columns


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
        world: World,
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

    def _step(self) -> Tensor:
        """(ranks, 4 + 22 * passes) int64: failure flag; numbers of own bodies, ghosts, and leaving bodies; counts."""
        world, columns = self._world, self.columns
        comm, id = world.comm, columns["id"]
        bodies = _bodies(columns, self._index)
        motion = self._motion(bodies)
        _require_rigid(motion)
        scene = scene_of(world._meshes, columns)
        scene._leave_out(id < 0)
        moving = MovingBodies.of(scene, motion, wait=False)
        # The rows of contacts with ghosts are found concurrently with the search of own pairs.
        share, _ = search_share(
            self._decomposition,
            columns_to_send(id, moving),
            moving,
            lambda ghosts: ghosts,
            world.options,
            world._rank.estimates,
            beside=lambda share: share.passes[-1].first_contacts(),
            sizes=self._sizes,
            synchronises=False,
            discard=self._failed,
            slack=GRAPH_SLACK,
        )
        counts = [search_pass.counts() for search_pass in share.passes]
        overflow = [flag for of_pass in counts for flag in overflow_flags(of_pass)]
        incomplete = (
            torch.cat([self._failed, share.overflow, moving._first_invalid_rows()[-1:], *overflow]).sum().reshape(1)
        )
        first, incomplete = _first_toi(share, comm, incomplete)
        new = _with_position(self._response(bodies, motion, first))
        is_body = id >= 0
        leaving = count_leaving(self._decomposition, new["position"].contiguous(), id)
        is_valid = ((new["position"].abs() <= LARGEST_COORDINATE).all(dim=1) | ~is_body).all()
        failed = incomplete | ~is_valid
        owned, ghosts = is_body.sum()[None], (share.held.ghosts["id"] >= 0).sum()[None]
        mine = torch.cat([failed, owned, ghosts, leaving, *counts])
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

    def _committed(self, index: int, record: NDArray[np.int64], seconds: float) -> _Committed:
        owned, ghosts, leaving = record[:, 1:4].T
        counts = record[:, 4:].reshape(len(record), -1, len(COUNT_ROWS))
        pcs, contacts = (counts[:, :, COUNT_ROWS[name]].sum(axis=1) for name in ("pairs_written", "contacts"))
        spent = (1e-9 * busy_nanoseconds(counts)).tolist()
        loads = RankLoads(owned.tolist(), pcs.tolist(), contacts.tolist(), spent)
        found = WorldStep(int(pcs.sum()), int(contacts.sum()), replayed=True)
        return _Committed(index, found, loads, int(leaving.sum()), int(ghosts.sum()))


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
