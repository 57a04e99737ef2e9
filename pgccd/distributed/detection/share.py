"""One rank's share of a step: pairs of own bodies, then pairs with ghosts.

A pair of own bodies of which one reaches no other rank is this rank's. These pairs are searched while ghosts are sent;
then ghosts are paired with the own bodies near them, and own bodies that reach other ranks with each other, on a GPU
concurrently with that search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.detection import broad, narrow
from pgccd.detection.bodies import MovingBodies
from pgccd.detection.checks import Initial, check_separation, operator_tolerance
from pgccd.detection.memory import CapacityEstimate
from pgccd.detection.parts import Part, find_part, first_contacts_of, pairs_of_step
from pgccd.detection.query import Query
from pgccd.distributed.comm.exchange import Columns
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.body_columns import bodies_of, of_checked, take_bodies
from pgccd.distributed.halo.capacity import HaloCapacity
from pgccd.distributed.halo.centres import Centres, centres_of
from pgccd.distributed.halo.ghosts import Halo
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.vertices import Vertices, vertex_counts
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.side_stream import SideStream
from pgccd.runtime.stages import StageClock

T = TypeVar("T")

#: From columns of bodies to their scene and motion, bitwise equal on every rank that holds a body. For deforming bodies
#: the columns include those of their vertices.
Build = Callable[[Columns], tuple[Scene, RigidMotion | VertexMotion]]


#: A function of the held bodies, the centres of ghosts (of all bodies on a single rank), min_separation and tolerance
#: as the operators take them, and the decomposition.
OfHeld = Callable[[Held, Centres, tuple[float, float], Decomposition], T]


@dataclass(frozen=True)
class Options:
    """Options of `pgccd.detect`, and how to run it."""

    report: narrow.Report = "first"
    min_separation: float = 0.0
    tolerance: float | None = None
    nonzero_toi: bool = False
    broad_phase: broad.BroadPhase = "auto"
    #: Whether pairs of own bodies are searched while ghosts are sent. The result does not depend on it.
    overlap: bool = True
    initial: Initial = "report"

    def check(self) -> None:
        """Raises TypeError or ValueError, naming the option, if one is invalid."""
        arguments.choice(self.report, "report", narrow.REPORTS)
        _ = self.query  # checks its own
        arguments.choice(self.broad_phase, "broad_phase", broad.BROAD_PHASES)
        arguments.flag(self.overlap, "overlap")

    @property
    def query(self) -> Query:
        """The options of each part."""
        # Rows are not in the order of ids, which breaks ties.
        report: narrow.Report = "first" if self.report == "earliest" else self.report
        return Query(report, self.min_separation, self.tolerance, self.nonzero_toi, self.initial)


@dataclass
class PartEstimates:
    """Capacity estimates of the parts; owned by a simulation or `World`."""

    own: CapacityEstimate = field(default_factory=CapacityEstimate)
    with_ghosts: CapacityEstimate = field(default_factory=CapacityEstimate)


@dataclass(frozen=True)
class Share:
    """One rank's share of a step: pairs of own bodies and, with several ranks, pairs with ghosts or at the boundary."""

    held: Held
    parts: list[Part]
    ghosts: MovingBodies | None  #: None on a single rank
    kept: tuple[float, float]  #: min_separation and tolerance, as the operators take them

    @property
    def pairs(self) -> Tensor:
        """(P, 2) int64: the PCS as rows of the held bodies, the one with the smaller id first; rows of -1 may be
        anywhere.
        """
        return pairs_of_step(self.parts)

    def first_contacts(self) -> tuple[Tensor, Tensor]:
        """Pairs (K, 2) as rows of the held bodies, and toi (K,), of all parts: see `Part.first_contacts`."""
        return first_contacts_of(self.parts)


class OwnSearch:
    """The part of one rank's step that needs no ghosts: finds the pairs of its own bodies and starts their search.

    On a GPU this does not synchronise if the capacity for pairs can be estimated; otherwise ghosts are sent first.

    Args:
        decomposition: of space.
        own: columns of this rank's own bodies, "id" ascending; these columns are sent for ghosts.
        build: makes scene and motion from columns.
        options: of the detection.
        clock: records stage times.
        estimates: of the capacities of parts.
        capacity: of the halo, if it can be estimated; the same on all ranks. On GPUs ghosts are then sent without
            exchanging counts first.
        vertices: of the own bodies, if they deform.

    Raises:
        ValueError: a pose is invalid.

    Example:
        >>> search = OwnSearch(decomposition, own, build, Options(), StageClock(), PartEstimates())
        >>> share = search.start().with_ghosts()
    """

    def __init__(
        self,
        decomposition: Decomposition,
        own: Columns,
        build: Build,
        options: Options,
        clock: StageClock,
        estimates: PartEstimates,
        capacity: HaloCapacity | None = None,
        vertices: Vertices | None = None,
    ) -> None:
        self._vertices = vertices
        self._decomposition, self._comm = decomposition, decomposition.comm
        self._own, self._build = own, build
        self._options, self._clock, self._estimates = options, clock, estimates
        self._capacity = capacity
        self._kept = check_separation(options.min_separation), operator_tolerance(options.tolerance)

    def start(self) -> OwnSearch:
        """Computes the motion, sends ghosts, and starts the search of pairs of own bodies."""
        with self._clock.stage("plan"):
            own = self._own if self._vertices is None else {**self._own, **self._vertices.columns}
            self._bodies = MovingBodies.of(*self._build(own), wait=False)
        with self._clock.stage("halo"):
            self._halo = Halo(self._decomposition, self._own, self._bodies, self._kept)
            self._halo.find_boundary()
        self._side = SideStream(self._bodies.device, self._options.overlap and self._comm.size > 1)
        if self._comm.size > 1:
            self._send_ghosts()
        self._find_own_pairs()
        return self

    def _send_ghosts(self) -> None:
        with self._side, self._clock.stage("halo"):
            if self._capacity is not None and _sends_ahead(self._comm, self._side):
                self._halo.send_padded(self._capacity)
            elif not self._side.is_apart:  # otherwise sent after the own search has started, since sending synchronises
                self._halo.send()
        if not self._options.overlap:
            _ = self._held  # waits for ghosts now

    def _find_own_pairs(self) -> None:
        with self._clock.stage("broad"):
            asked = self._options.query, self._options.broad_phase
            elsewhere = self._halo.reach if self._comm.size > 1 else None
            self._part = find_part(self._bodies, *asked, estimate=self._estimates.own, elsewhere=elsewhere)
        self._part.begin()

    @cached_property
    def _held(self) -> Held:
        """The held bodies. Waits for ghosts."""
        with self._side, self._clock.stage("halo wait"):
            return self._halo.wait()

    @cached_property
    def _ghost_vertices(self) -> Vertices | None:
        """Vertices of ghosts, if the bodies deform. Waits for them."""
        if self._vertices is None:
            return None
        held, meshes = self._held, self._bodies.scene.meshes
        return self._vertices.send(held.route, vertex_counts(meshes, held.ghosts["mesh_index"]))

    @cached_property
    def _ghosts(self) -> MovingBodies:
        with self._side, self._clock.stage("halo"):
            ghosts, vertices = self._held.ghosts, self._ghost_vertices
            return of_checked(*self._build(ghosts if vertices is None else {**ghosts, **vertices.columns}))

    @cached_property
    def _near(self) -> tuple[Tensor, HostCopy]:
        """Rows of own bodies near ghosts or at the boundary, and their number.

        If this rank tests a ghost against an own body, both reach a common cell, in which the body's box overlaps the
        box around all ghosts. Pairs of two bodies that reach other ranks are found together with those of ghosts.
        """
        where = *self._kept, *self._decomposition.subdomain
        own, ghosts = centres_of(self._bodies), centres_of(self._ghosts)
        with self._side, self._clock.stage("halo"):
            near, found = ops.near_ghosts(own, self._halo.reach, ghosts, *where)
            return near, HostCopy.start(found)

    def of_held(self, make: OfHeld[T]) -> T:
        """The result of a function that runs concurrently with the search. Waits for ghosts."""
        held, centres = self._held, centres_of(self._bodies if self._comm.size == 1 else self._ghosts)
        if self._comm.size > 1:
            _ = self._near  # started first, so that its count is available later
        with self._side, self._clock.stage("halo"):
            return make(held, centres, self._kept, self._decomposition)

    def with_ghosts(self) -> Share:
        """The whole share: waits for ghosts, and starts the search of pairs with them."""
        options = self._options
        if self._comm.size == 1:
            return Share(self._held, [self._part], None, self._kept)
        held, ghosts, (near, near_count) = self._held, self._ghosts, self._near
        where = *self._kept, self._halo.reach, *self._decomposition.subdomain
        with self._side:
            with self._clock.stage("halo"):
                rows = _with_ghosts(near[: int(near_count.numpy()[0])], held)
                columns = take_bodies(self._bodies, ghosts, rows)
                at_boundary = bodies_of(self._bodies, columns, self._vertices_of(rows))

                def owned(pairs: Tensor) -> tuple[Tensor, Tensor]:
                    return ops.owned_pairs(pairs, rows, held.id, centres_of(at_boundary), *where)

                find = options.query, options.broad_phase, owned
                with_ghosts = find_part(at_boundary, *find, rows=rows, estimate=self._estimates.with_ghosts)
            with self._side.sharing():
                with_ghosts.begin()
        self._side.join()
        return Share(held, [self._part, with_ghosts], ghosts, self._kept)

    def _vertices_of(self, rows: Tensor) -> Vertices | None:
        """Vertices of held bodies (B,), if they deform."""
        if self._vertices is None or self._ghost_vertices is None:
            return None
        return Vertices.join(self._vertices, self._ghost_vertices).take(rows)


def _sends_ahead(comm: Comm, side: SideStream) -> bool:
    """Whether ghosts can be sent without waiting for their number."""
    return side.is_apart and comm.goes_with_the_stream


def _with_ghosts(near: Tensor, held: Held) -> Tensor:
    """(B,) int64: rows of own bodies near ghosts or at the boundary, then of all ghosts."""
    return torch.cat([near, torch.arange(held.own_count, len(held), device=near.device)])
