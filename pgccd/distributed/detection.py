"""Detection by many ranks: every pair of bodies is tested by exactly one of them.

Pairs of own bodies are searched while the ghosts are under way, then those with ghosts among the bodies near them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from pgccd import broad, narrow, ops
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns
from pgccd.distributed.halo import Halo, Held, HeldExchange, centres_of
from pgccd.distributed.partition import Partition
from pgccd.distributed.side_stream import SideStream
from pgccd.motion import RigidMotion
from pgccd.parts import Part, contacts_of_step, pairs_of_step
from pgccd.query import Query
from pgccd.scene import FILTERS, Scene
from pgccd.stages import StageClock

#: From columns of bodies to their scene and motion: the same bits on every rank that holds a body.
Build = Callable[[Columns], tuple[Scene, RigidMotion]]


@dataclass(frozen=True)
class Options:
    """What `pgccd.detect` is asked for, see there; and how."""

    report: narrow.Report = "first"
    min_separation: float = 0.0
    tolerance: float | None = None
    nonzero_toi: bool = False
    broad_phase: broad.BroadPhase = "auto"
    #: Whether pairs of own bodies are searched while ghosts are under way. The result does not depend on it.
    overlap: bool = True

    @property
    def query(self) -> Query:
        """What each part is asked."""
        # Rows are not in the order of ids, which decides among equal ones.
        report: narrow.Report = "first" if self.report == "earliest" else self.report
        return Query(report, self.min_separation, self.tolerance, self.nonzero_toi)


@dataclass(frozen=True)
class Share:
    """What one rank tests in one step: pairs of own bodies, and if there are other ranks those with ghosts."""

    held: Held
    parts: list[Part]
    ghosts: MovingBodies | None  #: if there are other ranks
    side: SideStream  #: on which ghosts came
    min_separation: float

    @property
    def pairs(self) -> Tensor:
        """(P, 2) int64: the PCS as rows of bodies held, that of the smaller id first; rows of -1 among them."""
        return pairs_of_step(self.parts)

    def exchange(self, partition: Partition) -> HeldExchange:
        """How ranks that hold a body agree about it."""
        with self.side:
            nobody = centres_of(self.parts[0].bodies)
            centres = nobody if self.ghosts is None else centres_of(self.ghosts)
            return HeldExchange(self.held, centres, self.min_separation, partition)


@dataclass(frozen=True)
class Detection:
    """What one rank found in one step."""

    share: Share  #: whose parts have been searched
    contacts: Contacts  #: as rows of bodies held

    @property
    def held(self) -> Held:
        return self.share.held

    @cached_property
    def pairs(self) -> Tensor:
        """(P, 2) int64: the PCS as rows of bodies held, that of the smaller id first."""
        return torch.cat([part.in_step(_pairs_of(part)) for part in self.share.parts])

    def cells(self, partition: Partition) -> tuple[Tensor, Tensor]:
        """(P,) and (K,) int64: the cells of the lower corners of the intersections of the boxes of pairs, and of those
        that collide."""
        parts = self.share.parts
        lower = [ops.swept_boxes(*centres_of(part.bodies), self.share.min_separation)[0] for part in parts]
        of_pairs = [_cells(partition, corner, _pairs_of(part)) for part, corner in zip(parts, lower, strict=True)]
        of_contacts = [_cells(partition, at, part.find().pairs) for part, at in zip(parts, lower, strict=True)]
        return torch.cat(of_pairs), torch.cat(of_contacts)


def _pairs_of(part: Part) -> Tensor:
    return part.pairs[: part.find().stats.pcs]


def _cells(partition: Partition, lower: Tensor, pairs: Tensor) -> Tensor:
    return partition.cell_of(torch.maximum(lower[pairs[:, 0]], lower[pairs[:, 1]]))


def detect_distributed(
    comm: Comm,
    partition: Partition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
) -> Detection:
    """Finds the contacts of this rank's share of pairs; the shares of all ranks together are all pairs, once each.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        own: columns of the bodies this rank owns, "id" ascending; those that other ranks need to know of ghosts.
        build: their scene and motion.
        options: what to find.
        clock: stages are timed here.
    """
    share = find_share(comm, partition, own, build, options, clock, Part.begin)
    found = contacts_of_step(share.parts)
    clock.add(found.stats.seconds)
    if options.report == "earliest":
        found = _earliest(found, share.held.id)
    return Detection(share, replace(found, stats=replace(found.stats, bodies=len(share.held))))


def find_share(
    comm: Comm,
    partition: Partition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
    begin: Callable[[Part], object],
) -> Share:
    """The pairs that this rank is to test, and all that it must know of their bodies; arguments as above.

    Args:
        begin: called with each part as soon as it is known.
    """
    separation = broad.check_separation(options.min_separation)
    with clock.stage("plan"):
        bodies = MovingBodies(*build(own), wait=False)
    with clock.stage("halo"):
        halo = Halo(comm, partition, own, bodies, separation)
    side = SideStream(bodies.device, options.overlap and comm.size > 1)
    if comm.size == 1:
        with clock.stage("broad"):
            part = Part("own", options.query, bodies, broad.find_pairs(bodies, separation, options.broad_phase))
        begin(part)
        return Share(halo.wait(), [part], None, side, separation)
    if not side.is_apart:
        with clock.stage("halo"):
            halo.send()
    held = None if options.overlap else _wait(halo, clock)
    where = separation, halo.reach, partition.territory(comm.rank)
    with clock.stage("broad"):
        pairs = broad.find_pairs(bodies, separation, options.broad_phase)
        found = ops.owned_pairs(pairs, None, own["id"], centres_of(bodies), *where)
        of_own = Part("own", options.query, bodies, *found)
    # A GPU is first given something to do, as the others' answers take their time.
    begin(of_own)
    with side:
        if side.is_apart:
            with clock.stage("halo"):
                halo.send()
        held = held or _wait(halo, clock)
        with clock.stage("halo"):
            ghosts = _told(*build(held.ghosts))
            rows = _near_ghosts(bodies, ghosts, separation, partition.territory(comm.rank))
            at_border = _bodies(bodies, _taken(bodies, ghosts, rows))
        with clock.stage("broad"):
            crossing = broad.find_pairs(at_border, separation, options.broad_phase)
            found = ops.owned_pairs(crossing, rows, held.id, centres_of(at_border), *where)
            with_ghosts = Part("with ghosts", options.query, at_border, *found, rows)
    side.join()
    begin(with_ghosts)
    return Share(held, [of_own, with_ghosts], ghosts, side, separation)


def _near_ghosts(bodies: MovingBodies, ghosts: MovingBodies, separation: float, territory: ops.Territory) -> Tensor:
    """(B,) int64: the rows of all own bodies near ghosts, and of ghosts.

    A ghost and an own body that meet in a cell of this rank both reach it, and there the body's box overlaps the box
    around all ghosts.
    """
    near, found = ops.near_ghosts(centres_of(bodies), centres_of(ghosts), separation, territory)
    own_count, ghost_count = bodies.scene.body_count, ghosts.scene.body_count
    return torch.cat([near[: int(found)], torch.arange(own_count, own_count + ghost_count, device=near.device)])


def _taken(bodies: MovingBodies, ghosts: MovingBodies, rows: Tensor) -> Columns:
    """Columns of both: own bodies first."""
    own, more = _columns(bodies), _columns(ghosts)
    return dict(zip(own, ops.take_rows(list(own.values()), [more[name] for name in own], rows), strict=True))


def _earliest(contacts: Contacts, id: Tensor) -> Contacts:
    """The one with the least toi, of equal ones that of the smallest ids; none, if there are none."""
    assert contacts.toi is not None
    if len(contacts) == 0:
        return contacts
    first = torch.nonzero(contacts.toi == contacts.toi.min())[:, 0]
    pairs = id[contacts.pairs[first]]
    first = first[torch.argsort(pairs[:, 1], stable=True)]
    chosen = first[torch.argsort(id[contacts.pairs[first]][:, 0], stable=True)][:1]
    columns = {name: column[chosen] for name, column in vars(contacts).items() if isinstance(column, Tensor)}
    return replace(contacts, **columns, stats=replace(contacts.stats, contacts=1))


def _told(scene: Scene, motion: RigidMotion) -> MovingBodies:
    """Of bodies whose owners have checked them."""
    pose = motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    return MovingBodies(scene, RigidMotion.of_checked(*pose, motion.path))


def _wait(halo: Halo, clock: StageClock) -> Held:
    with clock.stage("halo wait"):
        return halo.wait()


_MOTION = ("position_t0", "orientation_t0", "position_t1", "rotation")


def _columns(bodies: MovingBodies) -> Columns:
    """All that a scene and a motion say of each body."""
    columns = {name: getattr(bodies.motion, name) for name in _MOTION}
    columns |= {name: getattr(bodies.scene, name) for name in ("mesh_index", "radius", *FILTERS)}
    return {name: column for name, column in columns.items() if column is not None}


def _bodies(like: MovingBodies, columns: Columns) -> MovingBodies:
    """The reverse: bodies of the same meshes on paths of the same kind."""
    filters = {name: columns[name] for name in FILTERS if name in columns}
    scene = Scene.of_checked(like.scene.meshes, columns["mesh_index"], **filters)
    scene.radius = columns["radius"]
    position_t0, orientation, position_t1, rotation = (columns[name] for name in _MOTION)
    path = cast(RigidMotion, like.motion).path
    return MovingBodies(scene, RigidMotion.of_checked(position_t0, orientation, position_t1, rotation, path))
