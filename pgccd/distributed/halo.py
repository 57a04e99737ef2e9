"""What a rank must know of others' bodies for one step: ghosts of all that reach a cell of its own.

A body is sent to every rank that owns any cell its CBV's box reaches (corners touch many cells, a fast body too). Two
boxes that overlap share the lower corner of their intersection; the rank that owns the cell of that reference point
holds both bodies, since the point lies in both boxes, and is the one that tests the pair. It may own neither.

Most bodies reach no cell of others. One pass finds those that do; all else is in proportion to these.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd import ops
from pgccd.bodies import MovingBodies
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Arrival, Columns, Route
from pgccd.distributed.partition import Partition

#: Centres at t0 and t1 (N, 3) and SBV radius (N,) of bodies.
Centres = tuple[Tensor, Tensor, Tensor]


def centres_of(bodies: MovingBodies) -> Centres:
    """Of moving bodies."""
    return bodies.position_t0, bodies.position_t1, bodies.radius


@dataclass(frozen=True)
class Held:
    """The bodies a rank holds for one step: rows 0 to N - 1 are its own, rows N to N + G - 1 ghosts."""

    own_id: Tensor  #: (N,) int64, ascending
    ghosts: Columns  #: of G bodies, "id" among them, in the order in which they came: by owner, then by id
    route: Route  #: that brought them: its rows count own bodies
    border: Tensor  #: (B,) int64, ascending: rows of own bodies that others hold too
    holders: Tensor  #: (B, ranks) uint8: 1 for each of these others
    border_counts: Tensor  #: (ranks,) int64: how many of these bodies each of them holds

    def __len__(self) -> int:
        return self.own_count + self.ghost_count

    @property
    def own_count(self) -> int:
        return len(self.own_id)

    @property
    def ghost_count(self) -> int:
        return len(self.ghosts["id"])

    @functools.cached_property
    def id(self) -> Tensor:
        """(N + G,) int64."""
        return torch.cat([self.own_id, self.ghosts["id"]])

    @functools.cached_property
    def owner(self) -> Tensor:
        """(N + G,) int64: the rank that owns each."""
        return torch.cat([torch.full_like(self.own_id, self.route.comm.rank), self.route.source])


class Halo:
    """The ghosts of one step, under way from construction on.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        own: columns of this rank's own bodies that others need, "id" ascending.
        bodies: these, moving; not checked yet.
        min_separation: length.

    Raises:
        ValueError: a pose is invalid.
    """

    def __init__(
        self, comm: Comm, partition: Partition, own: Mapping[str, Tensor], bodies: MovingBodies, min_separation: float
    ) -> None:
        self._own_id = own["id"]
        #: (N,) uint8: 1 for own bodies that reach cells of others; None if there are no others.
        self.reach: Tensor | None = None
        self._arrival: Arrival | None = None
        if comm.size == 1:
            bodies.motion.check()
            bodies.checked = True
            nobody = own["id"][:0]
            self._ghosts = {name: column[:0] for name, column in own.items()}
            self._route = Route(comm, nobody, [0], [0])
            self._border, self._holders = nobody, nobody.new_empty((0, 1), dtype=torch.uint8)
            self._counts = nobody.new_zeros(1)
            return
        centres, territory = centres_of(bodies), partition.territory(comm.rank)
        self.reach, border, found = ops.border_bodies(centres, min_separation, territory)
        count, *faults = torch.cat([found, bodies.first_faults()]).tolist()
        bodies.raise_faults(faults)
        bodies.checked = True
        border = border[:count]
        holders, counts = ops.holders_of(centres, min_separation, territory, border, comm.size)
        sent, received = torch.stack([counts, comm.exchange_counts(counts)]).tolist()
        self._border, self._holders, self._counts = border, holders, counts
        self._route = Route(comm, ops.rows_by_rank(holders, border, sum(sent)), sent, received)
        self._arrival = self._route.forward(own)

    def wait(self) -> Held:
        """The bodies held, once all ghosts are here."""
        if self._arrival is not None:
            self._ghosts = self._arrival.wait()
        return Held(self._own_id, self._ghosts, self._route, self._border, self._holders, self._counts)


class HeldExchange:
    """How ranks agree on the first toi of the bodies they hold (`pgccd.sim.Exchange`).

    All that hold a body tell one another directly. Its owner knows who they are, the others see where it reaches; each
    two ranks list the bodies both hold by owner, then by id.

    Args:
        held: the bodies.
        centres: of all of them.
        min_separation: length.
        partition: that the halo was made with.
    """

    def __init__(self, held: Held, centres: Centres, min_separation: float, partition: Partition) -> None:
        self._comm = comm = held.route.comm
        self._told: torch.cuda.Event | None = None
        if comm.size == 1:
            self._shared = held.own_id[:0], [0]
            return
        received, row = held.route.received, torch.arange(held.own_count, len(held), device=held.own_id.device)
        territory = partition.territory(comm.rank)
        holders, counts = ops.holders_of(centres, min_separation, territory, row, comm.size, received)
        before = sum(received[: comm.rank])
        self._holders = torch.cat([holders[:before], held.holders, holders[before:]])
        self._rows = torch.cat([row[:before], held.border, row[before:]])
        # On its way while bodies are tested; read when that is over, so that nothing waits for it.
        self._counts = (counts + held.border_counts).to("cpu", non_blocking=True)
        if row.is_cuda:
            self._told = torch.cuda.Event()
            self._told.record()

    @functools.cached_property
    def _shared(self) -> tuple[Tensor, list[int]]:
        """Rows of bodies that others hold too, by rank; and how many for each rank."""
        if self._told is not None:
            self._told.synchronize()
        counts = self._counts.tolist()
        return ops.rows_by_rank(self._holders, self._rows, sum(counts)), counts

    @property
    def shared(self) -> Tensor:
        """(S,) int64: rows of bodies that others hold too; more than once if several do."""
        return self._shared[0]

    @property
    def rank(self) -> int:
        return self._comm.rank

    @property
    def ranks(self) -> int:
        return self._comm.size

    def share(self, first: Tensor) -> None:
        """Sets that of all bodies (N + G,) float64 to the smallest."""
        if self._comm.size == 1:
            return
        rows, counts = self._shared
        message = first.index_select(0, rows).view(torch.uint8).view(-1, first.element_size())
        answer = self._comm.exchange(message, counts, counts).wait()
        first.scatter_reduce_(0, rows, answer.view(first.dtype)[:, 0], "amin")

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._comm.all_gather(values)
