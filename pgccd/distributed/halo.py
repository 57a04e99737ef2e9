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

#: Bits of `reach`: the body reaches cells of other ranks; it is a ghost.
REACHES_OTHERS, IS_GHOST = 1, 2

#: Centres at t0 and t1 (N, 3) and SBV radius (N,) of bodies.
Centres = tuple[Tensor, Tensor, Tensor]


def centres_of(bodies: MovingBodies) -> Centres:
    """Of moving bodies."""
    return bodies.position_t0, bodies.position_t1, bodies.radius


@dataclass(frozen=True)
class Held:
    """The bodies a rank holds for one step: rows 0 to N - 1 are its own, rows N to N + G - 1 ghosts."""

    own_id: Tensor  #: (N,) int64, ascending
    ghosts: Columns  #: of G bodies, "id" among them, in the order in which they came
    route: Route  #: that brought them: its rows count own bodies

    def __len__(self) -> int:
        return len(self.own_id) + len(self.ghosts["id"])

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
        #: (N,) uint8: REACHES_OTHERS for own bodies that do; None if there are no others.
        self.reach: Tensor | None = None
        self._arrival: Arrival | None = None
        if comm.size == 1:
            bodies.motion.check()
            nobody = own["id"][:0]
            self._ghosts = {name: column[:0] for name, column in own.items()}
            self._route = Route(comm, nobody, [0], [0])
            return
        centres, territory = centres_of(bodies), partition.territory(comm.rank)
        self.reach, border, found = ops.border_bodies(centres, min_separation, territory)
        count, *faults = torch.cat([found, bodies.first_faults()]).tolist()
        bodies.raise_faults(faults)
        border = border[:count]
        reached = ops.reached_ranks(centres, min_separation, territory, border, comm.size)
        reached[:, comm.rank] = 0
        counts = reached.sum(dim=0)
        sent, received = torch.stack([counts, comm.exchange_counts(counts)]).tolist()
        if any(sent):  # by rank, then by body; how many is known
            border = border[torch.nonzero_static(reached.t().contiguous(), size=sum(sent))[:, 1]]
        self._route = Route(comm, border, sent, received)
        self._arrival = self._route.forward(own)

    def wait(self) -> Held:
        """The bodies held, once all ghosts are here."""
        if self._arrival is not None:
            self._ghosts = self._arrival.wait()
        return Held(self._own_id, self._ghosts, self._route)


class HeldExchange:
    """How ranks agree on the first toi of the bodies they hold (`pgccd.sim.Exchange`).

    Owners hear from all that hold a body, and tell them what came of it. Whether anybody changes travels with it: one
    more number to every rank.

    Args:
        held: the bodies.
    """

    def __init__(self, held: Held) -> None:
        self._route, self._device = held.route, held.own_id.device
        self._ghosts = slice(len(held.own_id), len(held))

    @functools.cached_property
    def shared(self) -> Tensor:
        """(S,) int64: rows of bodies that others hold too."""
        ghosts = torch.arange(self._ghosts.start, self._ghosts.stop, device=self._device)
        return torch.cat([self._route.rows, ghosts])

    @functools.cached_property
    def _places(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of rows and flags in messages sent, and in those received."""
        return *_with_flags(self._route.sent, self._device), *_with_flags(self._route.received, self._device)

    @property
    def rank(self) -> int:
        return self._route.comm.rank

    def collect(self, first: Tensor) -> None:
        """Lowers the first toi (N + G,) of own bodies to the smallest over all ranks that hold them."""
        if self._route.comm.size > 1:
            found = self._send(first[self._ghosts], self._route.received, self._route.sent)
            first.scatter_reduce_(0, self._route.rows, found, "amin")

    def share(self, first: Tensor) -> None:
        """Sets that of all bodies to the smallest."""
        if self._route.comm.size > 1:
            self.collect(first)
            first[self._ghosts] = self._send(first[self._route.rows], self._route.sent, self._route.received)

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._route.comm.all_gather(values)

    def spread(self, first: Tensor, changed: Tensor) -> Tensor:
        """Sets that of ghosts to their owners'; and says whether a body changes on any rank, (1,) bool."""
        comm = self._route.comm
        if comm.size == 1:
            return changed
        rows_sent, flags_sent, rows_received, flags_received = self._places
        message = first.new_empty(len(rows_sent) + comm.size)
        message[rows_sent] = first[self._route.rows]
        message[flags_sent] = changed.to(first.dtype)
        sent, received = ([count + 1 for count in counts] for counts in (self._route.sent, self._route.received))
        answer = self._send(message, sent, received)
        first[self._ghosts] = answer[rows_received]
        return (answer[flags_received] > 0.0).any().reshape(1)

    def _send(self, values: Tensor, sent: list[int], received: list[int]) -> Tensor:
        """float64 values, so many to and from each rank."""
        rows = values.view(torch.uint8).view(-1, values.element_size())
        return self._route.comm.exchange(rows, sent, received).wait().view(values.dtype)[:, 0]


def _with_flags(counts: list[int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Where rows and flags are in a message that has one flag after the rows of each rank."""
    each = torch.tensor(counts).to(device, non_blocking=True)
    ranks, total = torch.arange(len(counts), device=device), sum(counts)
    rows = torch.arange(total, device=device) + torch.repeat_interleave(ranks, each, output_size=total)
    return rows, each.cumsum(0) + ranks
