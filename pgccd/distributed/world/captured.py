"""Steps of a `World` as replays of one CUDA graph per rank, with motion and response as functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import arguments
from pgccd.detection.capacity import COUNT_ROWS, busy_nanoseconds, overflow_flags
from pgccd.detection.contacts import Contacts
from pgccd.detection.parts import first_contacts_of
from pgccd.distributed.comm.exchange import Columns, first_row
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.peer_memory import RowsOfRanks
from pgccd.distributed.detection.padded_share import (
    PaddedShare,
    ShareCapacity,
    can_replay,
    rows_with_slack,
    search_padded_share,
)
from pgccd.distributed.halo.migrate import count_leaving
from pgccd.distributed.launch.agreement import require_agreement
from pgccd.distributed.partition.balance import RankLoads
from pgccd.distributed.world.columns import scene_columns
from pgccd.distributed.world.world import World
from pgccd.motion.faults import LARGEST_COORDINATE
from pgccd.motion.paths import RigidMotion
from pgccd.runtime.replayed_steps import GRAPH_SLACK, ReplayedSteps
from pgccd.runtime.transaction import Replay, TransactionGraph

# Bodies that have left their rank's cells migrate once they exceed the number of ghosts over this (each may be a
# ghost).
_MOST_AWAY = 4


@dataclass(frozen=True, eq=False)
class Bodies:
    """The own bodies of one rank, as passed to user functions. In a graph, rows with negative ids are padding; their
    values have no effect.
    """

    id: Tensor  #: (N,) int64
    position: Tensor  #: (N, 3) float64, length units, world frame: positions of the origins
    mesh_index: Tensor  #: (N,) int32
    payload: Columns  #: by name: (N, ...)
    step: Tensor  #: (1,) int64: number of steps made


#: The motion of the next step.
Motion = Callable[[Bodies], RigidMotion]
#: From the bodies at t0, their motion, and the first toi of each (N,), inf without a contact, 0 throughout if the
#: search of any rank was incomplete: the position at the end of the step as "position", and other values of the payload
#: by name.
Response = Callable[[Bodies, RigidMotion, Tensor], Columns]


@dataclass(frozen=True)
class WorldStep:
    """Counts of one step, summed over ranks."""

    pcs: int  #: potentially colliding pairs
    contacts: int  #: pairs that collide
    replayed: bool  #: whether the step was a replay of a graph


@dataclass(frozen=True)
class _Committed:
    """A step that was committed on all ranks."""

    found: WorldStep
    loads: RankLoads
    leaving: int  #: bodies in parts of other ranks
    ghosts: int


class CapturedWorld(ReplayedSteps[WorldStep, _Committed, "_WorldGraph"]):
    """A loop of steps of a `World`: motion, detection, response.

    On GPUs (over NCCL, if there are several) a step is the replay of one CUDA graph per rank, with messages and both
    functions, and the host waits only for the record of the previous step. A step that exceeds a capacity changes
    nothing, and is repeated launch by launch; so are the last step of `run` and steps in which bodies migrate.
    Elsewhere all steps run launch by launch. The results are bitwise equal. In a step that will be repeated, or for
    which an error will be raised, contacts may be missing on any rank: `response` is then passed a first toi of 0 for
    every body of every rank.

    Args:
        world: with report="first".
        motion: called with the rank's `Bodies`. On a GPU it may only enqueue work, see `torch.cuda.graph`.
        response: called with the `Bodies`, the motion, and the first toi of each (N,) float64; returns new values by
            name: "position" (N, 3) and any payload. It may only enqueue work, too. All ranks call it in each step, so
            it may reduce values over them.
        graph: whether steps are replayed, the same on all ranks. Default: if possible.

    Raises:
        TypeError, ValueError: naming the argument.

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

    def __init__(self, world: World[Contacts], motion: Motion, response: Response, graph: bool | None = None) -> None:
        if not isinstance(world, World):
            raise TypeError(f"world: expected a pgccd.distributed.World, got {arguments.describe(world)}")
        if world.options.report != "first":
            raise ValueError(f'world: expected one with report="first", this has {world.options.report!r}')
        for name, function in (("motion", motion), ("response", response)):
            if not callable(function):
                raise TypeError(f"{name}: expected a function, got {arguments.describe(function)}")
        if world.vertex_payload:
            raise ValueError("world: expected one without vertex_payload: its motion is rigid")
        graph = can_replay(world.comm, world.id.device) if graph is None else graph
        super().__init__(graph and world.census.count > 0)
        self._world, self._motion, self._response = world, motion, response

    def run(self, steps: int) -> list[WorldStep]:
        """Runs steps. Afterwards `world` is in the final state, and each body is on its owner.

        Args:
            steps: their number, the same on all ranks.

        Raises:
            TypeError, ValueError: as `World.step` and `World.move` raise for the results of the functions; or ranks
                have different `steps` or `graph`.
        """
        steps = arguments.integer(steps, "steps", 0, "a number of steps >= 0")
        world, found = self._world, []
        require_agreement(world.comm, {"steps": steps, "graph": self._wants_graph})
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

    def _launch(self, index: int) -> WorldStep:
        world = self._world
        bodies = _bodies(world.columns, torch.full((1,), index, device=world.id.device))
        motion = self._motion(bodies)
        _require_rigid(motion)
        hits = world.step(motion)
        assert world.found is not None
        self._share = world.found.share
        counts = torch.tensor([len(world.found.pairs), len(world.found.contacts)])
        pcs, contacts = world.comm.sum(counts).tolist()
        world.move(**_with_position(self._response(bodies, motion, world.first_toi(hits))))
        return WorldStep(pcs, contacts, replayed=False)

    def _make_graph(self, index: int) -> _WorldGraph:
        world = self._world
        capacity = ShareCapacity.after(self._share, world.decomposition.neighbours)
        values = [4 + 2 * len(COUNT_ROWS), *capacity.halo.sent, *capacity.halo.received]
        world.comm.reserve_peer_messages(8 * (1 + max(values)))
        like = _any_body(world.comm, world.columns)
        return _WorldGraph(world, self._motion, self._response, capacity, like, index)

    def _begin(self, graph: _WorldGraph, index: int) -> None:
        self._world.comm.close_before(graph)
        graph.load(self._world.columns, index)

    def _is_captured(self, captured: bool) -> bool:
        return not self._world.comm.any(not captured)

    def _are_others_waiting(self, graph: _WorldGraph | None) -> bool:
        return self._world.comm.size > 1 and (graph is None or not graph.has_run)

    def _load(self, graph: _WorldGraph, index: int) -> bool:
        fits = len(self._world.id) <= len(graph.columns["id"]) and graph.decomposition.become(self._world.decomposition)
        if self._world.comm.any(not fits):
            return False
        graph.load(self._world.columns, index)
        return True

    def _take(self, graph: _WorldGraph) -> None:
        world = self._world
        world.columns = {name: column[: len(world.id)].clone() for name, column in graph.columns.items()}

    def _read(self, replay: Replay[_Committed], index: int) -> _Committed | None:
        comm = self._world.comm
        comm.guard.activity = "step"
        with comm.guard.waiting("step", for_gpu=comm.goes_with_the_stream):
            return replay.read(index)

    def _needs_launch(self, step: _Committed, enqueued: int) -> bool:
        # Space is redistributed after a step that is launched.
        balancer, steps_made = self._world.balancer, self._world.steps_made + 2 + enqueued
        decides = balancer.is_due(steps_made, self._world.comm.size) and not balancer.are_level(step.loads)
        return decides or _MOST_AWAY * step.leaving > step.ghosts


class _WorldGraph(TransactionGraph[_Committed]):
    """One rank's part of a step. It is committed if no rank exceeded a capacity and all poses are valid.

    Args:
        world: the graph is captured for its state.
        motion, response: of the user.
        capacity: of the halo and of own bodies near ghosts or at the boundary.
        like: columns of a body. Padding is a copy of it, so that the user's functions get valid values.
        index: of the next step.
    """

    def __init__(
        self,
        world: World[Contacts],
        motion: Motion,
        response: Response,
        capacity: ShareCapacity,
        like: Columns,
        index: int,
    ) -> None:
        device = world.id.device
        super().__init__(device)
        self._world, self._motion, self._response, self._capacity = world, motion, response, capacity
        #: A copy owned by the graph.
        self.decomposition = world.decomposition.copy()
        rows = rows_with_slack(len(world.id))
        #: Columns of the own bodies, then padding.
        self.columns = {name: column.expand(rows, *column.shape[1:]).clone() for name, column in like.items()}
        self.columns["id"].fill_(-1)
        self._index = torch.full((1,), index, dtype=torch.int64, device=device)

    def load(self, columns: Columns, index: int) -> None:
        """Loads another state, of at most as many bodies as rows."""
        self.columns["id"].fill_(-1)
        for name, column in columns.items():
            self.columns[name][: len(column)].copy_(column)
        self._index.fill_(index)
        self._failed.zero_()

    def _step(self) -> Tensor:
        """(ranks, 4 + 21 * parts) int64: failure flag; numbers of own bodies, ghosts, and leaving bodies; counts."""
        world, columns = self._world, self.columns
        comm, id = world.comm, columns["id"]
        bodies = _bodies(columns, self._index)
        motion = self._motion(bodies)
        _require_rigid(motion)
        own = scene_columns(columns) | motion.columns()
        asked = world.build, world.options, world.estimates, self._capacity, self._failed, GRAPH_SLACK
        share = search_padded_share(self.decomposition, own, *asked, of_held=lambda *held: None)
        for part in share.parts:
            part.begin()
        counts = [part.counts() for part in share.parts]
        overflow = [flag for of_part in counts for flag in overflow_flags(of_part)]
        incomplete = torch.cat([self._failed, share.failed, motion._first_faults()[-1:], *overflow]).sum().reshape(1)
        first, incomplete = _first_toi(share, comm, incomplete)
        new = _with_position(self._response(bodies, motion, first))
        is_body = id >= 0
        leaving = count_leaving(self.decomposition, new["position"].contiguous(), id)
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
        return _Committed(found, loads, int(leaving.sum()), int(ghosts.sum()))


def _first_toi(share: PaddedShare[None], comm: Comm, incomplete: Tensor) -> tuple[Tensor, Tensor]:
    """The first toi of each own body, (N,) float64, over all ranks that hold it; and whether the search of any rank was
    incomplete, (1,) int64 0 or 1. All toi are 0 then: contacts lost on one rank may be those of others' bodies.

    Args:
        share: of this rank.
        comm: between the ranks.
        incomplete: (1,) int64, nonzero if the search of this rank may have missed contacts.
    """
    held, own_count, peers = share.held, share.held.own_count, comm.peer_messages
    pairs, toi = first_contacts_of(share.parts)
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
