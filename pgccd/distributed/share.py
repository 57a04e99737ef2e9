"""What one rank tests in one step: the pairs of its own bodies, then those with ghosts.

Whether a pair of own bodies is its to test it knows without any ghost. These pairs are searched while ghosts are under
way; then ghosts meet the own bodies near them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from pgccd import broad, narrow, ops
from pgccd.bodies import MovingBodies
from pgccd.capacity import COUNT_ROWS
from pgccd.detect import expected_capacity
from pgccd.distributed.comm import Comm
from pgccd.distributed.exchange import Columns
from pgccd.distributed.halo import Halo, Held, HeldExchange, centres_of
from pgccd.distributed.partition import Partition
from pgccd.distributed.side_stream import SideStream
from pgccd.motion import RigidMotion
from pgccd.parts import Part, pairs_of_step
from pgccd.query import Query
from pgccd.scene import FILTERS, Scene
from pgccd.stages import StageClock
from pgccd.within import counts_of_given

# Of own pairs found without waiting: the part's name, and how much room there is, times what the last step needed. More
# than where it is known how many more pairs there are.
_OWN = "own, in a room"
_SLACK = 1.5

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


def find_share(
    comm: Comm,
    partition: Partition,
    own: Columns,
    build: Build,
    options: Options,
    clock: StageClock,
    begin: Callable[[Part], object],
) -> Share:
    """The pairs that this rank is to test, and all that it must know of their bodies.

    Args:
        comm: between the ranks.
        partition: the same on all of them.
        own: columns of the bodies this rank owns, "id" ascending; those that other ranks need to know of ghosts.
        build: their scene and motion.
        options: what to find.
        clock: stages are timed here.
        begin: called with each part as soon as it is known.

    Raises:
        ValueError: a pose is invalid.
    """
    separation = broad.check_separation(options.min_separation)
    with clock.stage("plan"):
        bodies = MovingBodies(*build(own), wait=False)
    with clock.stage("halo"):
        halo = Halo(comm, partition, own, bodies, separation)
    side = SideStream(bodies.device, options.overlap and comm.size > 1)
    if comm.size == 1:
        held = halo.wait()
        with clock.stage("broad"):
            part = Part("own", options.query, bodies, broad.find_pairs(bodies, separation, options.broad_phase))
        begin(part)
        return Share(held, [part], None, side, separation)
    if not side.is_apart:
        with clock.stage("halo"):
            halo.send()
    ghosts_first = None if options.overlap else _wait(halo, clock)
    where = separation, halo.reach, partition.territory(comm.rank)
    with clock.stage("broad"):
        of_own = _own_pairs(bodies, own["id"], where, options)
    # A GPU is first given something to do, as the others' answers take their time.
    begin(of_own)
    with side:
        if side.is_apart:
            with clock.stage("halo"):
                halo.send()
        held = ghosts_first or _wait(halo, clock)
        with clock.stage("halo"):
            ghosts = _told(*build(held.ghosts))
            rows = _near_ghosts(bodies, ghosts, separation, partition.territory(comm.rank))
            at_border = _bodies(bodies, _taken(bodies, ghosts, rows))
        with clock.stage("broad"):
            crossing = broad.find_pairs(at_border, separation, options.broad_phase)
            pairs, count = ops.owned_pairs(crossing, rows, held.id, centres_of(at_border), *where)
            with_ghosts = Part("with ghosts", options.query, at_border, pairs, counts_of_given(pairs, count), rows)
    side.join()
    begin(with_ghosts)
    return Share(held, [of_own, with_ghosts], ghosts, side, separation)


#: Separation, which own bodies reach cells of others, and whose cells are whose.
_Where = tuple[float, Tensor, ops.Territory]


def _own_pairs(bodies: MovingBodies, id: Tensor, where: _Where, options: Options) -> Part:
    """Pairs of own bodies that this rank is to test. On a GPU they are found without waiting, where room for them can
    be foreseen; the bodies need not be checked, then: if they are invalid there are no pairs.
    """
    query, separation = options.query, where[0]

    def owned(pairs: Tensor) -> tuple[Tensor, Tensor]:
        return ops.owned_pairs(pairs, None, id, centres_of(bodies), *where)

    def find_pairs() -> Tensor:
        pairs, count = owned(broad.find_pairs(bodies, separation, options.broad_phase))
        return pairs[: int(count)]

    capacity = expected_capacity(bodies, query, None, _OWN, slack=_SLACK) if _looks_ahead(bodies) else None
    if capacity is None:
        if not bodies.checked:
            bodies.raise_faults(bodies.first_faults().tolist())
        return Part("own", query, bodies, find_pairs())
    invalid, phase = bodies.first_faults()[-1:], options.broad_phase
    candidates, counts = broad.find_pairs_within(bodies, separation, phase, capacity, invalid)
    pairs, count = owned(candidates)
    row = COUNT_ROWS["pairs_written"]
    counts[row : row + 1].copy_(count)
    return Part(_OWN, query, bodies, pairs, counts, capacity=capacity, find_pairs=find_pairs)


def _looks_ahead(bodies: MovingBodies) -> bool:
    return bodies.device.type != "cpu"


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
