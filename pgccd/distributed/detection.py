"""Detection by many ranks: every pair of bodies is tested by exactly one of them.

Own bodies look for own partners while the ghosts are still under way; then ghosts for those near them. One detection
tests all pairs found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from pgccd import broad, narrow, ops
from pgccd.bodies import MovingBodies
from pgccd.contacts import Contacts
from pgccd.detect import find_contacts
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns, take_rows
from pgccd.distributed.halo import Centres, Halo, Held, HeldExchange, centres_of
from pgccd.distributed.partition import Partition
from pgccd.motion import RigidMotion
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
    #: Whether pairs of own bodies are looked for while ghosts are under way. The result does not depend on it.
    overlap: bool = True


@dataclass(frozen=True)
class Share:
    """What one rank tests in one step. Pairs are rows of bodies held, that of the smaller id first."""

    held: Held
    bodies: MovingBodies  #: those held
    pairs: Tensor  #: (P, 2) int64: the potentially colliding pairs
    min_separation: float

    def exchange(self, partition: Partition) -> HeldExchange:
        """How ranks that hold a body agree about it."""
        return HeldExchange(self.held, centres_of(self.bodies), self.min_separation, partition)


@dataclass(frozen=True)
class Detection:
    """What one rank found in one step."""

    held: Held
    pairs: Tensor  #: as of `Share`
    contacts: Contacts  #: of these pairs
    centres: Centres  #: of bodies held
    min_separation: float

    @classmethod
    def of(cls, share: Share, contacts: Contacts) -> Detection:
        """The contacts of a rank's share."""
        return cls(share.held, share.pairs, contacts, centres_of(share.bodies), share.min_separation)

    def reference_cells(self, partition: Partition, pairs: Tensor) -> Tensor:
        """(K,) int64: the cell of the lower corner of the intersection of the boxes of each pair (K, 2)."""
        lower = ops.swept_boxes(*self.centres, self.min_separation)[0]
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
    # Rows are not in the order of ids, which decides among equal ones.
    report: narrow.Report = "first" if options.report == "earliest" else options.report
    query = Query(report, options.min_separation, options.tolerance, options.nonzero_toi)
    share = find_share(comm, partition, own, build, options, clock)
    found = find_contacts(share.bodies, query, pairs=share.pairs)
    clock.add(found.stats.seconds)
    if options.report == "earliest":
        found = _earliest(found, share.held.id)
    return Detection.of(share, found)


def find_share(
    comm: Comm,
    partition: Partition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
) -> Share:
    """The pairs that this rank is to test, and all that it must know of their bodies; arguments as above."""
    separation = broad.check_separation(options.min_separation)
    territory = partition.territory(comm.rank)
    with clock.stage("plan"):
        bodies = MovingBodies(*build(own), wait=False)
    with clock.stage("halo"):
        halo = Halo(comm, partition, own, bodies, separation)
    held = None if options.overlap else _wait(halo, clock)
    with clock.stage("broad"):
        pairs = broad.find_pairs(bodies, separation, options.broad_phase)
    held = held or _wait(halo, clock)
    if halo.reach is None:  # there are no others
        return Share(held, bodies, pairs, separation)
    crossing, border = pairs[:0], held.border
    if held.ghost_count:
        with clock.stage("halo"):
            bodies = _joined(bodies, _told(*build(held.ghosts)))
            border = _border(bodies, held, separation, territory)
            at_border = _bodies(bodies, take_rows(_columns(bodies), border))
        with clock.stage("broad"):
            crossing = broad.find_pairs(at_border, separation, options.broad_phase)
    with clock.stage("broad"):
        # Whose reference point lies in a cell of this rank; of those that cross, only pairs with a ghost.
        where = (centres_of(bodies), separation, halo.reach, territory)
        owned, found = ops.owned_pairs(pairs, crossing, border, held.id, *where)
    return Share(held, bodies, owned[: int(found)], separation)


def _border(bodies: MovingBodies, held: Held, separation: float, territory: ops.Territory) -> Tensor:
    """(B,) int64: the rows of all own bodies near ghosts, and of ghosts.

    A ghost and an own body that meet in a cell of this rank both reach it, and there the body's box overlaps the box
    around all ghosts.
    """
    sizes = [held.own_count, held.ghost_count]
    own, ghosts = zip(*(column.split(sizes) for column in centres_of(bodies)), strict=True)
    near, found = ops.near_ghosts(own, ghosts, separation, territory)
    return torch.cat([near[: int(found)], torch.arange(held.own_count, len(held), device=near.device)])


def _joined(bodies: MovingBodies, ghosts: MovingBodies) -> MovingBodies:
    """Both, own bodies first."""
    own, more = _columns(bodies), _columns(ghosts)
    everybody = torch.arange(bodies.scene.body_count + ghosts.scene.body_count, device=bodies.device)
    joined = ops.take_rows(list(own.values()), [more[name] for name in own], everybody)
    return _bodies(bodies, dict(zip(own, joined, strict=True)))


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
