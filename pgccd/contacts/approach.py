"""How contacts go on after their toi: the rate at which the gap closes, and a proof that features come no closer.

The proof is along one direction n, fixed in the world: if n . (x_b - x_a) of all pairs of corners of two sets of
triangles stays above a distance for the rest of the step, so do the sets. A poor direction proves nothing, and the
contact counts as one that approaches. Where features touch exactly, their own normal does not tell on which side of one
another their surfaces are. There the sets include the faces around one of the features, which the surface would have
to pass through. See docs/explanation/exactness.md, section 15.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.contacts import Contacts
from pgccd.contacts.gradients import corner_points
from pgccd.contacts.kinds import FACE, Kind, Status
from pgccd.contacts.normals import surface_normals
from pgccd.contacts.sites import Sites, groups_of, on_cpu, reduced
from pgccd.contacts.trajectories import TrajectoryContacts
from pgccd.geometry.incidence import Lists
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import with_gradient_of
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.motion.vectors import cross, dot, norm, unit_or_zero
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import RELATIVE_TOLERANCE
from pgccd.search.trajectories import segments_as_step

# Windows of the rest of the step for bodies that turn.
_WINDOWS = 16
# Rounding of the expressions below, relative to the sum of what they add up.
_ROUNDING = 2.0**-46
# Pairs of sets that are tested together.
_MOST_SETS = 1 << 13
# Faces around a feature whose normals are tried as directions.
_MOST_FACES = 8
# Bound of rounding, relative to all sizes, of distances that are not further examined.
_ROUGHLY = 2.0**-40
# Sine of the angle between directions and a plane within which they may be rounded.
_SLIDING = 2.0**-36
# Places that differ by less than this part of the sizes involved are the same.
_SAME_PLACE = 1e-10
# Sine of the angle within which a direction is the normal of a face.
_PARALLEL = 1e-5


def approach_rates(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: Contacts) -> Tensor:
    """The rate at which the gap between the nearest points of contacts closes at toi, along `normal`, in the scene's
    length units per step (of a trajectory, per segment); divided by the duration of the step it is the normal approach
    velocity. Negative: they recede. 0: they rest or slide. Has gradients if toi has.

    Where features touch exactly, their normal may point to the wrong side on bodies that are not convex, unless
    `detect` was given normals="surface". If toi > 0 the rate is positive nevertheless: they were apart before. At t = 0
    it has the sign that the normal gives; `pgccd.approaching` does not depend on it.

    Args:
        scene, motion: with which `detect` found the contacts, unchanged.
        hits: K contacts, on the scene's device.

    Returns:
        (K,) float64. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if the contacts are those of one of several ranks.

    Example:
        >>> speed = pgccd.approach_rates(scene, motion, hits).clamp(min=0.0) / dt
    """
    copies, steps, bodies = moving_bodies(scene, motion, hits)
    with torch.no_grad():
        sites = Sites.of(hits, copies._detached(), steps._detached(), bodies)
        _require_same_paths(sites)
        normal = hits.normal.detach().cpu()
        rate = -dot(normal, sites.velocity())
        is_reversed = sites.is_reversed(normal) & (sites.kind <= Kind.EE)
        rate = torch.where(is_reversed, -rate, rate).to(bodies.device)
    if hits._differentiable is None:
        return rate
    _, velocity = corner_points(copies, steps, bodies, hits.kind, hits.features, hits.toi)
    speed = _weighted(hits, velocity)
    expression = -(hits.normal * (speed[:, 1] - speed[:, 0])).sum(1)  # its bits depend on the device
    expression = torch.where(is_reversed.to(bodies.device), -expression, expression)
    return with_gradient_of(rate, torch.where(hits.differentiable, expression, 0.0), "approach")


@dataclass
class Recession:
    """The proof that contacts recede: their features, and the surfaces around them, certainly come closer by at most
    `slack` in the rest of the step.

    Attributes:
        scene, motion: on the CPU, without gradients.
        slack: (N,), of each body; the smaller one of two counts.
    """

    scene: Scene
    motion: RigidMotion | VertexMotion
    slack: Tensor

    @classmethod
    def of(cls, scene: Scene, motion: RigidMotion | VertexMotion, slack: float | None) -> Recession:
        """Of bodies; slack None: 1e-6 of the SBV radius."""
        radius = scene._detached().radius
        slacks = RELATIVE_TOLERANCE * radius if slack is None else torch.full_like(radius, slack)
        return cls(*on_cpu(scene._detached(), motion._detached()), slacks.cpu())

    def is_certain(self, contacts: Contacts, bodies: Tensor, refuses_others: bool = False) -> Tensor:
        """(K,) bool: contacts of bodies (K, 2) that recede. Synchronises with a GPU.

        Raises:
            ValueError: `refuses_others`, and the contacts are those of another scene or motion.
        """
        sites = Sites.of(contacts, self.scene, self.motion, bodies)
        if refuses_others:
            _require_same_paths(sites)
        columns = (contacts.normal.detach().cpu(), contacts.status.cpu(), self.slack[sites.bodies].amin(1))
        parts = [_recedes(sites[rows], *(column[rows] for column in columns)) for rows in _parts(sites)]
        return torch.cat(parts).to(bodies.device) if parts else torch.zeros_like(bodies[:, 0], dtype=torch.bool)


def _parts(sites: Sites) -> Iterator[slice]:
    """Contacts that are tested together, so that memory is bounded: slices of rows."""
    counts = [sites.face_counts(*_surrounded(sites, side)) for side in (0, 1)]
    total = (1 + counts[0] + counts[1]).cumsum(0)
    begin = 0
    while begin < len(sites):
        before = int(total[begin - 1]) if begin else 0
        end = max(begin + 1, int(torch.searchsorted(total, before + _MOST_SETS, right=True)))
        yield slice(begin, end)
        begin = end


def moving_bodies(
    scene: Scene, motion: RigidMotion | VertexMotion | Trajectory, hits: Contacts
) -> tuple[Scene, RigidMotion | VertexMotion, Tensor]:
    """The scene and the motion of contacts, of a trajectory with copies of all bodies for each segment; and the rows of
    their bodies (K, 2).

    Raises:
        TypeError, ValueError: naming the argument that is not of these contacts.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
    if not isinstance(hits, Contacts):
        raise TypeError(f"hits: expected pgccd.Contacts, got {arguments.describe(hits)}")
    if hits._is_of_rank:
        raise ValueError("hits: are the contacts of one of several ranks, which does not have all paths")
    if hits.toi.device != scene.device:
        raise ValueError(f"hits: are on {hits.toi.device}, the scene on {scene.device}")
    if len(hits) and int(hits.pairs.amax()) >= scene.body_count:
        raise ValueError(f"hits: have body {int(hits.pairs.amax())}, the scene {scene.body_count} bodies")
    if isinstance(motion, Trajectory) != isinstance(hits, TrajectoryContacts):
        expected = "the trajectory" if isinstance(hits, TrajectoryContacts) else "the motion of the step"
        raise TypeError(f"motion: expected {expected} of the contacts, got {arguments.describe(motion)}")
    if isinstance(motion, Trajectory) and isinstance(hits, TrajectoryContacts):
        copies, steps, _ = segments_as_step(scene, motion, None)
        if len(hits) and int(hits.segment.amax()) >= motion.segment_count:
            expected = f"{int(hits.segment.amax()) + 1} segments or more, as the contacts have"
            raise ValueError(f"motion: expected {expected}, got {motion.segment_count}")
        return copies, steps, hits.pairs + hits.segment[:, None] * scene.body_count
    if not isinstance(motion, (RigidMotion, VertexMotion)):
        kinds = "a pgccd.RigidMotion, VertexMotion or Trajectory"
        raise TypeError(f"motion: expected {kinds}, got {arguments.describe(motion)}")
    if motion.device != scene.device:
        raise ValueError(f"motion: is on {motion.device}, the scene on {scene.device}")
    MovingBodies.of(scene._detached(), motion._detached())  # raises if it is not of these bodies
    return scene, motion, hits.pairs


def _require_same_paths(sites: Sites) -> None:
    """Raises ValueError if the features of contacts are elsewhere at toi: then the scene or the motion is another one,
    and what it says of the rest of the step is not about these contacts.
    """
    away, size = sites.point_error()
    is_wrong = ~(away <= _SAME_PLACE * size)
    if bool(is_wrong.any()):
        row = int(is_wrong.long().argmax())
        raise ValueError(
            f"motion: contact {row} is {float(away[row]):.3g} from where its features are at toi: give the scene and "
            "the motion with which the contacts were found, unchanged"
        )


def _weighted(contacts: Contacts, velocity: Tensor) -> Tensor:
    """(K, 2, 3): velocities of the nearest points of both features; of vertices with faces and of edges.

    Args:
        velocity: (K, 2, 3, 3), of corners, see `Corners`.
    """
    u, v = contacts.coordinates.unbind(1)
    zero = torch.zeros_like(u)
    weights = torch.stack([1.0 - u - v, u, v], 1)[:, None].expand(-1, 2, -1)
    on_edges = torch.stack([torch.stack([1.0 - u, u, zero], 1), torch.stack([1.0 - v, zero, v], 1)], 1)
    weights = torch.where((contacts.kind == Kind.EE)[:, None, None], on_edges, weights)
    return (weights[:, :, :, None] * velocity).sum(2)


def _recedes(sites: Sites, normal: Tensor, status: Tensor, slack: Tensor) -> Tensor:
    offset, noise = sites.offset()
    gap = norm(offset)
    is_apart = gap > noise
    is_known = (status == Status.TOUCH) & (sites.kind <= Kind.EE)
    certain = torch.zeros_like(is_apart)
    apart = torch.nonzero(is_apart & is_known)[:, 0]
    if len(apart):
        some = sites[apart]
        sets = _Sets.of(some, torch.arange(len(apart), device=gap.device), some.corners(0), some.corners(1))
        certain[apart] = sets.stay(unit_or_zero(offset[apart]), gap[apart], slack[apart])
    left = torch.nonzero(is_known & ~certain)[:, 0]
    if len(left):
        certain[left] = _surroundings_recede(sites[left], normal[left], offset[left], noise[left], slack[left])
    return certain


def _surroundings_recede(sites: Sites, normal: Tensor, offset: Tensor, noise: Tensor, slack: Tensor) -> Tensor:
    """As `_recedes`, by the surfaces around the features."""
    of_surface = surface_normals(sites, normal)
    gap = norm(offset)
    # How far the surfaces are apart, which edges in flat surfaces are not.
    gap = torch.minimum(gap, torch.minimum(*(_height(sites, side, offset, of_surface) for side in (0, 1))))
    owner, one, other = _sets_around(sites)
    met = (norm(offset) <= noise) & (sites.toi > 0.0)
    velocity = sites.velocity()
    speed = norm(velocity)
    around = []
    for side in (0, 1):
        where, face = sites.faces_around(*sites.supports(side), _MOST_FACES)
        around.append((_face_normals(sites, side, where, sites.incidence.faces[face]), where))

    def stay(rows: Tensor) -> Tensor:
        """(m,) bool: of pairs of sets (m,) those that stay apart along some direction."""
        place, corners = owner[rows], (one[rows], other[rows])
        sets = _Sets.of(sites, place, *corners)
        tried = [normal[place], *(_face_normals(sites, k, place, corners[k]) for k in (0, 1))]
        tried += [each for side in around for each in _in_turn(side, place)]
        directions = torch.stack([of_surface[place], *(sign * each for each in tried for sign in (1.0, -1.0))], 1)
        # Not from the other side, if the features are on one.
        is_open = (norm(directions) > 0.0) & (dot(directions, offset[place][:, None]) >= -noise[place][:, None])
        is_open &= sets.may_stay(directions, gap[place] - slack[place])
        certain = torch.zeros_like(place, dtype=torch.bool)
        for k in torch.nonzero(is_open.any(0))[:, 0].tolist():
            chosen = torch.nonzero(is_open[:, k] & ~certain)[:, 0]
            if len(chosen):
                certain[chosen] = stay_along(sets[chosen], directions[chosen, k])
        return certain

    def stay_along(sets: _Sets, along: Tensor) -> Tensor:
        """(m,) bool: of pairs of sets (m,) those that stay apart along directions (m, 3), one for each."""
        place = sets.owner
        stays = sets.stay(along, gap[place], slack[place])
        # Features that coincide were apart before, where they came from, or, if they slide, where the sets are.
        # Sets that came from elsewhere, or slide and are flat, must stay near the plane.
        came = torch.nonzero(stays & met[place])[:, 0]
        if len(came):
            sets, along, place = sets[came], along[came], place[came]
            closing = dot(along, -velocity[place])
            slides = closing.abs() <= _SLIDING * speed[place]
            is_flat = sets.apart_at_toi(-along) >= -slack[place]
            is_sided = torch.where(slides, ~is_flat, closing > 0.0)
            stays[came] = is_sided | sets.stay(-along, gap[place], slack[place])
        return stays

    # Most contacts that approach do so with any of their sets.
    every = torch.arange(len(owner), device=owner.device)
    first = reduced(every, owner, len(sites), "amin", len(owner))
    is_first = every == first[owner]
    certain = torch.ones_like(gap, dtype=torch.bool)
    for chosen in (is_first, ~is_first):
        rows = torch.nonzero(chosen & certain[owner])[:, 0]
        if len(rows):
            certain &= reduced(stay(rows).double(), owner[rows], len(sites), "amin", 1.0) > 0.0
    return certain


def _surrounded(sites: Sites, side: int) -> tuple[Tensor, Tensor]:
    """What of one side has faces around it that could pass through the other feature, and its row; -1: a face."""
    return torch.where(sites.counted[:, side] == FACE, -1, sites.counted[:, side]), sites.feature[:, side]


def _sets_around(sites: Sites) -> tuple[Tensor, Tensor, Tensor]:
    """Faces around a vertex or an edge with the other feature; of two edges both ways: what would pass through one
    another next to the contact. Contacts (n,), and vertices (n, 3) of i and of j.
    """
    owners, ones, others = [], [], []
    for side in (0, 1):
        place, face = sites.faces_around(*_surrounded(sites, side))
        around, beside = sites.incidence.faces[face], sites.corners(1 - side)[place]
        owners.append(place)
        ones.append(around if side == 0 else beside)
        others.append(beside if side == 0 else around)
    return torch.cat(owners), torch.cat(ones), torch.cat(others)


def _face_normals(sites: Sites, side: int, owner: Tensor, vertices: Tensor) -> Tensor:
    """(n, 3): unit normals at toi of triangles of vertices (n, 3) of one side of contacts; zero without an area."""
    a, b, c = (sites.arms(side, owner, vertex) for vertex in vertices.unbind(1))
    return unit_or_zero(cross(b - a, c - a))


def _in_turn(faces: tuple[Tensor, Tensor], owner: Tensor) -> Iterator[Tensor]:
    """For contacts `owner` (n,) the normals (n, 3) of their first, second, ... faces; zero without one.

    Args:
        faces: normals (m, 3), and contacts (m,).
    """
    normals, of = faces
    lists = Lists.of(of, torch.arange(len(of), device=of.device), int(owner.amax()) + 1)
    begin, end = lists.begin[owner], lists.begin[owner + 1]
    for k in range(int((end - begin).amax())):
        has = begin + k < end
        yield torch.where(has[:, None], normals[lists.items[torch.where(has, begin + k, 0)]], 0.0)


def _height(sites: Sites, side: int, offset: Tensor, normal: Tensor) -> Tensor:
    """(K,): how far the nearest point and the corners of the other feature are above faces of this side around the
    contact that have the normal (K, 3), the least of those whose foot is in such a face; inf without one.
    """
    sign = 1.0 if side == 0 else -1.0
    every = torch.arange(len(sites), device=offset.device)
    nearest = sites.nearest(1 - side)
    corners = [sites.arms(1 - side, every, corner) - nearest for corner in sites.corners(1 - side).unbind(1)]
    points = sign * offset[:, None] + torch.stack([torch.zeros_like(nearest), *corners], 1)  # (K, 4, 3)
    # Contacts at a vertex of many faces have the same faces and, most of them, the same normal.
    base, supports = sites.nearest(side), sites.supports(side)
    places = [sites.bodies[:, side], sites.toi, *supports, base, normal]
    if isinstance(sites.motion, VertexMotion):  # whose positions are relative to it
        places.append(sites.point)
    group, first = groups_of(*places)
    owner, face = sites.faces_around(supports[0][first], supports[1][first])
    owner = first[owner]
    ends = [sites.arms(side, owner, corner) - base[owner] for corner in sites.incidence.faces[face].unbind(1)]
    across = cross(ends[1] - ends[0], ends[2] - ends[0])
    is_face = (norm(across) > 0.0) & (norm(cross(unit_or_zero(across), normal[owner])) <= _PARALLEL)
    faces = torch.nonzero(is_face)[:, 0]
    owner, which = Lists.of(group[owner[faces]], faces, len(first)).take(group)
    ends, across, above = [end[which] for end in ends], across[which], points[owner]
    is_over = torch.ones_like(above[..., 0], dtype=torch.bool)
    for k in range(3):
        start, end = ends[k], ends[(k + 1) % 3]
        inward = cross(across, end - start)[:, None]
        is_over = is_over & (dot(inward, above - start[:, None]) >= 0.0)
    height = torch.where(is_over, sign * dot(normal[owner][:, None], above), torch.inf)
    return reduced(height.amin(1).clamp(min=0.0), owner, len(sites), "amin", torch.inf)


@dataclass
class _Paths:
    """Corners of n triangles on their paths: constant + rate t + cosine cos(angle t) + sine sin(angle t).

    Attributes:
        constant, rate, cosine, sine: (n, 3, 3), relative to the reference of the body.
        angle: (n, 1).
    """

    constant: Tensor
    rate: Tensor
    cosine: Tensor
    sine: Tensor
    angle: Tensor

    @classmethod
    def of(cls, sites: Sites, side: int, owner: Tensor, vertices: Tensor) -> _Paths:
        """Of vertices (n, 3) of one side of contacts (n,)."""
        motion = sites.motion
        start, end = (
            each.view(-1, 3, 3) for each in sites.ends(side, owner.repeat_interleave(3), vertices.reshape(-1))
        )
        zero = torch.zeros(1, 1, 1, dtype=start.dtype, device=start.device).expand_as(start)
        if isinstance(motion, VertexMotion) or motion.path == "linear":
            return cls(start, end - start, zero, zero, zero[:, 0, :1])
        rotation = motion.rotation[sites.bodies[:, side]][owner]
        angle = norm(rotation)[:, None]
        axis = unit_or_zero(rotation)[:, None]
        fixed = dot(axis, start)[..., None] * axis
        across = start - fixed
        turns = angle[:, :, None] > 0.0
        fixed, across = torch.where(turns, fixed, start), torch.where(turns, across, 0.0)
        return cls(fixed, zero, across, cross(axis, across), angle)

    def __getitem__(self, rows: Tensor) -> _Paths:
        return _Paths(*(getattr(self, each.name)[rows] for each in fields(self)))

    def along(self, direction: Tensor) -> _Along:
        """Along directions (n, 3)."""
        columns = (self.constant, self.rate, self.cosine, self.sine)
        constant, rate, cosine, sine = (dot(direction[:, None], each) for each in columns)
        return _Along(constant, rate, cosine, sine, self.angle.expand(-1, 3))

    def at(self, time: Tensor) -> Tensor:
        """(n, 3, 3): at times (n,)."""
        time = time[:, None, None]
        angle = self.angle[:, :, None] * time
        return self.constant + self.rate * time + (self.cosine * torch.cos(angle) + self.sine * torch.sin(angle))

    @property
    def size(self) -> Tensor:
        """(n,): bound of the sizes of all terms, and of their errors relative to one rounding."""
        turning = (1.0 + self.angle) * (norm(self.cosine) + norm(self.sine))
        return (norm(self.constant) + norm(self.rate) + turning).amax(1)


@dataclass
class _Sets:
    """n pairs of triangles of both bodies, or of parts of them.

    Attributes:
        owner: (n,) contacts.
        toi: (n,).
        turns: (n,) bool: a body turns, on an arc.
        between, change: (n, 3), see `Sites.travel`.
        one, other: paths of the corners of i and of j.
    """

    owner: Tensor
    toi: Tensor
    turns: Tensor
    between: Tensor
    change: Tensor
    one: _Paths
    other: _Paths

    @classmethod
    def of(cls, sites: Sites, owner: Tensor, one: Tensor, other: Tensor) -> _Sets:
        """Of vertices (n, 3) of i and of j."""
        toi, turns, between, change = (each[owner] for each in (sites.toi, sites.turns, *sites.travel()))
        paths = (_Paths.of(sites, 0, owner, one), _Paths.of(sites, 1, owner, other))
        return cls(owner, toi, turns, between, change, *paths)

    def __getitem__(self, rows: Tensor) -> _Sets:
        return _Sets(*(getattr(self, each.name)[rows] for each in fields(self)))

    def may_stay(self, directions: Tensor, needed: Tensor, part: float = 0.0) -> Tensor:
        """(n, d) bool: False along those of directions (n, d, 3) where `stay` is certainly False, since the sets are
        less than `needed` (n,) apart after a part of the time from toi on.
        """
        time = self.toi + part * (1.0 - self.toi)
        other = self.other.at(time) + (self.between + time[:, None] * self.change)[:, None]
        size = norm(self.between) + norm(self.change) + self.one.size + self.other.size
        one, two = (dot(directions[:, :, None], each[:, None]) for each in (self.one.at(time), other))  # (n, d, 3)
        return two.amin(2) - one.amax(2) >= (needed - _ROUGHLY * size)[:, None]

    def stay(self, direction: Tensor, gap: Tensor, slack: Tensor) -> Tensor:
        """(n,) bool: sets that stay at least `gap` (n,) less `slack` (n,) apart along directions (n, 3) from toi on."""
        needed = gap - slack
        straight, turning = torch.nonzero(~self.turns)[:, 0], torch.nonzero(self.turns)[:, 0]
        for part in (1.0 / _WINDOWS, 1.0) if len(turning) else ():  # cheaper than all windows
            turning = turning[self[turning].may_stay(direction[turning][:, None], needed[turning], part)[:, 0]]
        found = torch.zeros_like(self.turns)
        for rows, lowest_of in ((straight, _Sets._lowest_on_lines), (turning, _Sets._lowest_on_arcs)):
            if len(rows):
                lowest, error = lowest_of(self[rows], direction[rows])
                found[rows] = lowest - error >= needed[rows]
        return found

    def _along(self, direction: Tensor) -> tuple[Tensor, Tensor, _Along, _Along]:
        """Along directions (n, 3): the offset of the references at t = 0 and its change (n, 1), and the corners of i
        and j (n, 3).
        """
        start, change = (dot(direction, each)[:, None] for each in (self.between, self.change))
        return start, change, self.one.along(direction), self.other.along(direction)

    def apart_at_toi(self, direction: Tensor) -> Tensor:
        """(n,): how far sets are apart at toi along directions (n, 3)."""
        start, change, a, b = self._along(direction)
        time = self.toi[:, None]
        at_a, at_b = (points.at(time[:, None])[0][..., 0] for points in (a, b))
        return (start + change * time)[:, 0] + (at_b.amin(1) - at_a.amax(1))

    def _lowest_on_lines(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """How far sets stay apart at least (n,), along directions (n, 3), from toi on, and a bound of the error of that
        (n,). No body turns: it is least at one of the ends.
        """
        start, change, a, b = self._along(direction)
        gaps = []
        for time in (self.toi[:, None], 1.0):
            at_a, at_b = a.constant + a.rate * time, b.constant + b.rate * time
            gaps.append((start + change * time)[:, 0] + (at_b.amin(1) - at_a.amax(1)))
        size = (start.abs() + change.abs())[:, 0] + a.size.amax(1) + b.size.amax(1)
        return torch.minimum(*gaps), _ROUNDING * size

    def _lowest_on_arcs(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """As `_lowest_on_lines`, of bodies that turn: in windows of time, by the chord between their ends and by the
        tangent at their beginning.
        """
        start, change, a, b = self._along(direction)
        toi = self.toi[:, None]
        time = toi + (1.0 - toi) * torch.linspace(0.0, 1.0, _WINDOWS + 1, dtype=torch.float64, device=toi.device)
        step = ((1.0 - toi) / _WINDOWS)[:, None]
        (at_a, rate_a, turn_a), (at_b, rate_b, turn_b) = a.at(time[:, None]), b.at(time[:, None])  # (n, 3, windows + 1)
        (low_a, high_a), (low_b, high_b) = a.curvatures(turn_a, step), b.curvatures(turn_b, step)
        lowest = torch.full_like(start[:, 0], torch.inf)
        for k in range(3):
            for m in range(3):
                gap = start + change * time + (at_b[:, m] - at_a[:, k])
                slope = (change + rate_b[:, m] - rate_a[:, k])[:, :-1]
                low, high = low_b[:, m] - high_a[:, k], high_b[:, m] - low_a[:, k]
                first, last, length = gap[:, :-1], gap[:, 1:], step[:, 0]
                chord = torch.minimum(first, last) - high.clamp(min=0.0) * length * length / 8.0
                bottom = torch.where(low > 0.0, -slope / torch.where(low > 0.0, low, 1.0), length)
                bottom = torch.minimum(bottom.clamp(min=0.0), length)
                # Where the tangent's parabola is concave, its ends are lowest.
                tangent = torch.minimum(first, first + bottom * (slope + 0.5 * low * bottom))
                lowest = torch.minimum(lowest, torch.maximum(chord, tangent).amin(1))
        size = (start.abs() + change.abs())[:, 0] + a.size.amax(1) + b.size.amax(1)
        return lowest, _ROUNDING * size


@dataclass
class _Along:
    """Points along directions, as constant + rate t + cosine cos(angle t) + sine sin(angle t).

    Attributes:
        constant, rate, cosine, sine, angle: (n, 3).
    """

    constant: Tensor
    rate: Tensor
    cosine: Tensor
    sine: Tensor
    angle: Tensor

    @property
    def size(self) -> Tensor:
        """Bound of the sizes of all terms, and of their errors relative to one rounding."""
        turning = (1.0 + self.angle) * (self.cosine.abs() + self.sine.abs())
        return self.constant.abs() + self.rate.abs() + turning

    def at(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values, derivatives and turning parts at times, which broadcast against (..., 1)."""
        angle, cosine, sine = self.angle[..., None], self.cosine[..., None], self.sine[..., None]
        c, s = torch.cos(angle * time), torch.sin(angle * time)
        turning = cosine * c + sine * s
        change = angle * (sine * c - cosine * s)
        return self.constant[..., None] + self.rate[..., None] * time + turning, self.rate[..., None] + change, turning

    def curvatures(self, turning: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds (..., n) of the second derivative in windows of length (..., 1), from turning parts (..., n + 1)."""
        square = (self.angle * self.angle)[..., None]
        radius = torch.hypot(self.cosine, self.sine)[..., None]
        stray = square * radius * step * step / 8.0
        low = torch.minimum(turning[..., :-1], turning[..., 1:]) - stray
        high = torch.maximum(turning[..., :-1], turning[..., 1:]) + stray
        return -square * torch.minimum(high, radius), -square * torch.maximum(low, -radius)
