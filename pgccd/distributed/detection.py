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
from pgccd.detect import detect
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns
from pgccd.distributed.halo import IS_GHOST, REACHES_OTHERS, Centres, Halo, Held, centres_of
from pgccd.distributed.partition import Partition
from pgccd.motion import RigidMotion
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
class Detection:
    """What one rank found in one step. Pairs are rows of bodies held, that of the smaller id first."""

    held: Held
    pairs: Tensor  #: (P, 2) int64: the potentially colliding pairs this rank tests
    contacts: Contacts  #: of these pairs
    centres: tuple[Centres, Centres]  #: of own bodies and of ghosts
    min_separation: float

    def reference_cells(self, partition: Partition, pairs: Tensor) -> Tensor:
        """(K,) int64: the cell of the lower corner of the intersection of the boxes of each pair (K, 2)."""
        lower = torch.cat([ops.swept_boxes(*centres, self.min_separation)[0] for centres in self.centres])
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
    separation = broad.check_separation(options.min_separation)
    with clock.stage("plan"):
        bodies = MovingBodies(*build(own), wait=False)
    with clock.stage("halo"):
        halo = Halo(comm, partition, own, bodies, separation)
    share = _Share(comm.rank, partition, options, clock)
    held = None if options.overlap else _wait(halo, clock)
    pairs = share.pairs(bodies, halo.reach, only_ghosts=False)
    held = held or _wait(halo, clock)
    own_count, ghosts = len(held.own_id), held.ghosts
    ghost_bodies = _told(*build(ghosts)) if len(ghosts["id"]) else None
    rows = None
    if ghost_bodies is not None:
        with clock.stage("halo"):
            columns, reach, rows = share.border(held, bodies, halo.reach, ghost_bodies)
            border = _bodies(bodies, columns)
        crossing = share.pairs(border, reach, only_ghosts=True)
        with clock.stage("halo"):
            # Every pair's smaller id comes first: among own bodies, and among those at the border.
            own_columns = _columns(bodies)
            merged = {name: torch.cat([column, columns[name]]) for name, column in own_columns.items()}
            tested = _bodies(bodies, merged)
            pairs_tested = torch.cat([pairs, crossing + own_count])
            pairs = torch.cat([pairs, rows[crossing]])
    else:
        tested, pairs_tested = bodies, pairs
    found = detect(
        tested.scene,
        cast(RigidMotion, tested.motion),
        # Rows are not in the order of ids, which decides among equal ones.
        "first" if options.report == "earliest" else options.report,
        separation,
        tolerance=options.tolerance,
        nonzero_toi=options.nonzero_toi,
        pairs=pairs_tested,
    )
    clock.add(found.stats.seconds)
    found.stats.bodies = len(held)
    if rows is not None:
        at_border = rows[(found.pairs - own_count).clamp_(min=0)]
        found = replace(found, pairs=torch.where(found.pairs < own_count, found.pairs, at_border))
    if options.report == "earliest":
        found = _earliest(found, held.id)
    ghost_centres = (column[:0] for column in centres_of(bodies)) if ghost_bodies is None else centres_of(ghost_bodies)
    return Detection(held, pairs, found, (centres_of(bodies), cast(Centres, tuple(ghost_centres))), separation)


class _Share:
    """What one rank tests."""

    def __init__(self, rank: int, partition: Partition, options: Options, clock: StageClock) -> None:
        self._territory = partition.territory(rank)
        self._options, self._clock = options, clock

    def pairs(self, bodies: MovingBodies, reach: Tensor | None, only_ghosts: bool) -> Tensor:
        """Potentially colliding pairs whose reference point lies in a cell of this rank: all, if nobody reaches
        others' (None)."""
        separation = self._options.min_separation
        with self._clock.stage("broad"):
            pairs = broad.find_pairs(bodies, separation, self._options.broad_phase)
            if reach is None:
                return pairs
            owned, found = ops.owned_pairs(pairs, centres_of(bodies), separation, reach, only_ghosts, self._territory)
            count = int(found)
            return pairs if count == len(pairs) else pairs[owned[:count]]

    def border(
        self, held: Held, bodies: MovingBodies, reach: Tensor | None, ghosts: MovingBodies
    ) -> tuple[Columns, Tensor, Tensor]:
        """Ghosts and all own bodies near them, by ascending id: columns, reach and rows of bodies held.

        A ghost and an own body that meet in a cell of this rank both reach it, and there the body's box overlaps the
        box around all ghosts.
        """
        assert reach is not None  # else there were no ghosts
        separation = self._options.min_separation
        near, found = ops.near_ghosts(centres_of(bodies), centres_of(ghosts), separation, self._territory)
        near = near[: int(found)]
        order = torch.argsort(torch.cat([held.own_id[near], held.ghosts["id"]]))
        ghost_columns = _columns(ghosts)
        columns = {
            name: torch.cat([column[near], ghost_columns[name]])[order] for name, column in _columns(bodies).items()
        }
        count = len(held.ghosts["id"])
        reach = torch.cat([reach[near], reach.new_full((count,), REACHES_OTHERS | IS_GHOST)])[order]
        own_count = len(held.own_id)
        rows = torch.cat([near, torch.arange(own_count, own_count + count, device=near.device)])[order]
        return columns, reach, rows


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
    columns |= {name: getattr(bodies.scene, name) for name in ("mesh_index", *FILTERS)}
    return {name: column for name, column in columns.items() if column is not None}


def _bodies(like: MovingBodies, columns: Columns) -> MovingBodies:
    """The reverse: bodies of the same meshes on paths of the same kind."""
    filters = {name: columns[name] for name in FILTERS if name in columns}
    scene = Scene.of_checked(like.scene.meshes, columns["mesh_index"], **filters)
    position_t0, orientation, position_t1, rotation = (columns[name] for name in _MOTION)
    path = cast(RigidMotion, like.motion).path
    return MovingBodies(scene, RigidMotion.of_checked(position_t0, orientation, position_t1, rotation, path))
