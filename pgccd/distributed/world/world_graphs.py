"""One step of a `World` as a CUDA graph, with the functions of the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.peer_memory import RowsOfRanks
from pgccd.distributed.detection.options import SearchOptions
from pgccd.distributed.detection.replica_exchange import ReplicaExchange
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.migrate import leaving_and_invalid
from pgccd.distributed.partition.balance import RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.world.functions import (
    Bodies,
    Motion,
    Response,
    Tally,
    bodies_of,
    fixed_of,
    motion_of,
    tallied,
    with_position,
)
from pgccd.distributed.world.input_checks import columns_to_send, scene_of
from pgccd.distributed.world.resolve import listed_search, options_of_resolution
from pgccd.distributed.world.world import World
from pgccd.motion.paths import RigidMotion
from pgccd.resolution.counts import SearchCounts
from pgccd.resolution.rounds import Attempt, ids_of
from pgccd.runtime.replayed_steps import GRAPH_SLACK
from pgccd.runtime.sizes import COUNT_ROWS, busy_nanoseconds, overflow_flags
from pgccd.runtime.stages import StageClock
from pgccd.runtime.transaction import TransactionGraph
from pgccd.search.bodies import MovingBodies

T = TypeVar("T")


@dataclass(frozen=True)
class WorldStep:
    """Counts of one step, summed over ranks.

    Attributes:
        pcs: potentially colliding pairs.
        contacts: pairs that collide.
        replayed: whether the step was a replay of a graph.
        rounds: detections in rounds, in a step that is resolved.
        tally: sums of the values of `tally`, modulo 2^64; empty without one.
    """

    pcs: int
    contacts: int
    replayed: bool
    rounds: int = 0
    tally: tuple[int, ...] = ()


@dataclass(frozen=True)
class Committed:
    """A step that was committed on all ranks: see `CommittedByRanks`."""

    index: int
    found: WorldStep
    loads: RankLoads
    leaving: int
    ghosts: int


@dataclass(frozen=True, eq=False)
class _Answer:
    """In a graph: what the response to a step is passed, and what the record of the step holds."""

    share: Share
    motion: RigidMotion
    values: Tensor  #: (N,) float64: the first toi of each own body, or the fraction that it moves
    incomplete: Tensor  #: (1,) int64: whether the search of any rank was incomplete
    changes: Tensor  #: int64, of this rank, in rounds
    counts: list[Tensor]  #: (22,) int64 of each pass


class WorldGraph(TransactionGraph[Committed]):
    """One rank's part of a step. It is committed if no rank exceeded a capacity and all poses are valid.

    Args:
        world: the graph is captured for its state.
        motion, response, tally: of the user.
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
        tally: Tally | None,
        decomposition: Decomposition,
        sizes: HaloSizes,
        index: int,
        padding: Columns,
        rows: int,
    ) -> None:
        self._none, self._owned = torch.zeros((2, 1), dtype=torch.int64, device=world.id.device)
        super().__init__(world.columns, index, padding, rows)
        self._world, self._motion, self._response, self._tally = world, motion, response, tally
        self.options = world._search_options
        self._decomposition, self._sizes = decomposition, sizes

    rounds = 0  #: of resolution

    def load(self, columns: Mapping[str, Tensor], index: int) -> None:
        """As of `TransactionGraph`."""
        super().load(columns, index)
        self._owned.fill_(len(columns["id"]))

    def _step(self) -> Tensor:
        """(ranks, 4 + changes + k + 22 * passes) int64: failure flag; numbers of own bodies, ghosts, leaving bodies;
        `changes` of rounds; what is tallied; counts.
        """
        world, columns = self._world, self.columns
        comm, id = world.comm, columns["id"]
        bodies = bodies_of(columns, self._index)
        motion, bodies, planned = motion_of(self._motion, bodies)
        scene = scene_of(world.meshes, columns)
        scene._leave_out(id < 0)
        moving = MovingBodies.of(scene, motion, wait=False)
        answer = self._answer(bodies, moving, motion)
        new = planned | with_position(self._response(bodies, answer.motion, answer.values))
        new = {name: values.contiguous() for name, values in new.items()}
        leaving, invalid = leaving_and_invalid(self._decomposition, new["position"], id).split(1)
        ghosts = self._none if comm.size == 1 else (answer.share.held.ghosts["id"] >= 0).sum()[None]
        tally = answer.changes[:0]
        if self._tally is not None:
            pairs, toi = answer.share.first_contacts()
            pairs = ids_of(answer.share.held.id, pairs)
            tally = tallied(self._tally, bodies, new, answer.motion, answer.values, pairs, toi)
        self._tally_width = len(tally)
        failed = answer.incomplete + invalid
        mine = torch.cat([failed, self._owned, ghosts, leaving, answer.changes, tally, *answer.counts])
        record = comm.all_gather(mine) if comm.peer_messages is None else comm.peer_messages.gather(mine)
        torch.clamp(record[:, 0].amax(dim=0, keepdim=True), max=1, out=self._failed)
        self._index += 1 - self._failed
        written = [columns[name if name == "position" else "." + name] for name in new]
        # A response may return columns of the state under other names.
        state = {column.untyped_storage().data_ptr() for column in columns.values()}
        values = [each.clone() if each.untyped_storage().data_ptr() in state else each for each in new.values()]
        ops.commit_rows(written, values, id, self._failed)
        return record

    def _answer(self, bodies: Bodies, moving: MovingBodies, motion: RigidMotion) -> _Answer:
        """Enqueues the search of the step."""
        # The rows of contacts with ghosts are found concurrently with the search of own pairs.
        share, _ = self._search(moving, {}, self.options, lambda share: share.passes[-1].first_contacts())
        counts = [search_pass.counts() for search_pass in share.passes]
        incomplete = self._incomplete(moving, share, [flag for of_pass in counts for flag in overflow_flags(of_pass)])
        first, incomplete = _first_toi(share, self._world.comm, incomplete)
        return _Answer(share, motion, first, incomplete, incomplete[:0], counts)

    def _search(
        self, moving: MovingBodies, marks: Columns, options: SearchOptions, concurrent_work: Callable[[Share], T]
    ) -> tuple[Share, T]:
        """`search_share` in the graph's capacities; `marks` (N, ...) are sent with ghosts."""
        return search_share(
            self._decomposition,
            columns_to_send(self.columns["id"], moving) | marks,
            moving,
            lambda ghosts: ghosts,
            options,
            self._world._rank.estimates,
            concurrent_work=concurrent_work,
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

    def _committed(self, index: int, record: NDArray[np.int64], seconds: float) -> Committed:
        owned, ghosts, leaving = record[:, 1:4].T
        begin = 5 + self.rounds if self.rounds else 4
        rounds = int(np.argmin(record[:, 4:begin].max(axis=0))) if self.rounds else 0
        tally = tuple(record[:, begin : begin + self._tally_width].sum(axis=0).tolist())
        counts = record[:, begin + self._tally_width :].reshape(len(record), -1, len(COUNT_ROWS))
        pcs, contacts = (counts[:, :, COUNT_ROWS[name]].sum(axis=1) for name in ("pairs_written", "contacts"))
        spent = (1e-9 * busy_nanoseconds(counts)).tolist()
        loads = RankLoads(owned.tolist(), pcs.tolist(), contacts.tolist(), spent)
        found = WorldStep(int(pcs.sum()), int(contacts.sum()), True, rounds, tally)
        return Committed(index, found, loads, int(leaving.sum()), int(ghosts.sum()))


class ResolvingGraph(WorldGraph):
    """The graph of a step that is resolved. The step is not committed if it needs more rounds than were captured.

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
        comm, plan, options = world.comm, world._resolution_plan, options_of_resolution(self.options, lists=True)
        fixed = fixed_of(self._movable, bodies)
        marks = {} if fixed is None else {"fixed": fixed}

        def start_exchange(share: Share) -> ReplicaExchange:
            exchange = ReplicaExchange.start(share, self._decomposition, self._sizes.common, comm.peer_messages)
            share.passes[-1].first_contacts()
            return exchange

        share, exchange = self._search(moving.stoppable(), marks, options, start_exchange)
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


def _first_toi(share: Share, comm: Comm, incomplete: Tensor) -> tuple[Tensor, Tensor]:
    """The first toi of each own body, (N,) float64, over all ranks that hold it; and whether the search of any rank was
    incomplete, (1,) int64 0 or 1. All toi are 0 then: contacts lost on one rank may be of bodies of other ranks.

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
