"""How far bodies must be moved along a direction until they are apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy.typing as npt
import torch
from torch import Tensor

from pgccd import arguments
from pgccd.contacts.contacts import Contacts
from pgccd.contacts.kinds import Kind
from pgccd.contacts.rows import Form, Rows
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import sum_of_margins
from pgccd.motion.of_scene import at_start
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.vectors import norm
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import check_pairs, warn_of_rounded_positions
from pgccd.search.detect import detect_moving
from pgccd.search.distance import distance
from pgccd.search.query import Query

# See section 17 of docs/explanation/exactness.md: how much points on the way and points that are translated later may
# differ, relative to the largest coordinate and the size of the pair; and the part of the way that is added to it.
_POINTS = 2.0**-47
_WAY = 2.0**-40
# The factor by which each step back from the upper bound is longer than the one before.
_LONGER = 4.0
# For bodies with more pairs of faces than this, the way is halved a few times before it is searched: where they overlap
# deeply, very many features meet.
_FEW_FACES = 1 << 12
_HALVINGS = 6


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ExitDistances(Rows):
    """Certified bounds of the translations that bring body pairs apart, made by `pgccd.exit_distance`.

    Attributes:
        pairs: (K, 2) int64, i < j: body j is translated, body i stays.
        lower: (K,) float64 >= 0, length: body j translated by `lower` times `direction` certainly touches or intersects
            body i. 0 if no such translation was found.
        upper: (K,) float64 >= `lower`, length: body j translated by any s > `upper` times `direction` is certainly
            apart from body i. 0 if they are apart for all s > 0.
        direction: (K, 3) float64, world frame, of length 1 to within rounding.

    Example:
        >>> out = pgccd.exit_distance(scene, motion, [0.0, 0.0, 1.0])
        >>> shift = out.upper[:, None] * out.direction  # (K, 3), of bodies out.pairs[:, 1]
    """

    pairs: Tensor
    lower: Tensor
    upper: Tensor
    direction: Tensor

    _names: ClassVar[tuple[str, ...]] = ("pairs", "lower", "upper", "direction")
    _forms: ClassVar[Mapping[str, Form]] = {
        "pairs": (torch.int64, (2,)),
        "lower": (torch.float64, ()),
        "upper": (torch.float64, ()),
        "direction": (torch.float64, (3,)),
    }

    def __repr__(self) -> str:
        """The number of pairs, and the bounds of the largest distance of all."""
        if not len(self):
            return f"ExitDistances(count=0, device={self.pairs.device})"
        largest = f"largest={float(self.lower.max()):.6g}..{float(self.upper.max()):.6g}"
        return f"ExitDistances(count={len(self)}, {largest}, device={self.pairs.device})"


def exit_distance(
    scene: Scene,
    motion: RigidMotion | VertexMotion,
    direction: Tensor | npt.ArrayLike,
    *,
    pairs: Tensor | None = None,
    min_separation: float = 0.0,
    tolerance: float | None = None,
) -> ExitDistances:
    """How far one body of each pair must be translated along a direction until the two are apart for good. With bodies
    at rest where a motion starts, that is the least s >= 0 such that body j, translated by any larger s times the
    direction, is further than min_separation from body i. Finds a lower and an upper bound, both certified.

    Bodies are apart if their surfaces, with their margins, are apart and no connected piece of one is inside of the
    other, a solid. If a translation brings a body out of another one and then into it again, the last way out counts.
    The least distance over many directions is an upper bound of the depth of penetration.

    Args:
        scene: the bodies.
        motion: their paths, of which only the start counts; see `RigidMotion.at_rest`.
        direction: (3,), world frame, of any length but 0; with `pairs` also (P, 3), one for each pair.
        pairs: (P, 2) int64, i < j, in any order, also repeated: body j of each is translated relative to body i. The
            scene's filters and `exclude` are not applied to them. Default: all pairs that the filters allow and that
            touch at the start, as `pgccd.collide` reports them at rest.
        min_separation: length >= 0, added to the margins: bodies at most this far apart touch.
        tolerance: length: the upper bound is where surfaces last come within min_separation + tolerance. The lower
            bound is searched for in steps back from the upper one, which begin with the tolerance and grow by factors
            of four. Default: 1e-6 of the smaller SBV radius of each pair.

    Returns:
        ExitDistances, on the scene's device: a row for each pair, in the order given; by default sorted. For `upper`,
        bodies touch if rounding of translated positions to float64 may bring them into contact. `lower` is certified
        for exact translations of rigid bodies; for deforming bodies, for vertices rounded to float64. It is 0 where
        surfaces only ever touch and none certainly passes through the other, such as exactly aligned boxes of equal
        size. Synchronises with a GPU, once for each step back.

    Raises:
        TypeError, ValueError: naming the argument; also if a pair is too large, or an input requires grad.

    Example:
        >>> still = pgccd.RigidMotion.at_rest(torch.zeros(2, 3), q)  # both in the same place
        >>> out = pgccd.exit_distance(scene, still, [0.0, 0.0, 2.0])
        >>> out.pairs, out.upper  # 1: the height of the bodies, to within a millionth
    """
    arguments.instance(scene, "scene", Scene)
    arguments.instance(motion, "motion", RigidMotion, VertexMotion)
    query = Query("first", min_separation, tolerance, False, "assume_free")
    motion._refuse_gradient()
    bodies = MovingBodies.of(scene, at_start(motion))
    unit = _unit_vectors(direction, scene.device)
    if pairs is not None:
        pairs = check_pairs(pairs, scene, deforms=False)
        if unit.dim() == 2 and len(unit) != len(pairs):
            raise ValueError(f"direction: expected shape (3,) or ({len(pairs)}, 3), one per pair, got {len(unit)} rows")
    elif unit.dim() == 2:
        raise ValueError(f"direction: expected shape (3,) unless pairs are given, got {tuple(unit.shape)}")
    else:
        pairs = detect_moving(bodies, Query("any", query.min_separation, tolerance, False)).pairs
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    directions = unit.expand(len(pairs), 3).contiguous()
    if not len(pairs):
        lower, upper = torch.zeros((2, 0), dtype=torch.float64, device=scene.device)
        return ExitDistances(pairs=pairs, lower=lower, upper=upper, direction=directions)
    moved = _MovedApart.of(bodies, pairs, directions, query.lengths[0])
    below = moved.halved(query.lengths[0])
    upper = moved.upper(query, below)
    lower = moved.lower(below, upper, *query.lengths)
    warn_of_rounded_positions(scene, motion)
    return ExitDistances(pairs=pairs, lower=lower, upper=upper, direction=moved.direction)


def _unit_vectors(direction: Tensor | npt.ArrayLike, device: torch.device) -> Tensor:
    """(3,) or (P, 3): the directions, scaled to length 1."""
    expected = "a vector (3,), or one per pair (P, 3)"
    given = arguments.real_numbers(direction, "direction", expected)
    if given.dim() not in (1, 2) or given.shape[-1] != 3:
        raise ValueError(f"direction: expected {expected}, got shape {tuple(given.shape)}")
    if not isinstance(direction, Tensor):
        given = given.to(device)
    elif given.device != device:
        raise ValueError(f"direction: expected device {device}, got {given.device}")
    largest = given.abs().amax(dim=-1, keepdim=True)
    sound = (largest > 0.0) & (largest < torch.inf)
    if not bool(sound.all()):
        row = int((~sound).reshape(-1).long().argmax())
        where = f"row {row}: " if given.dim() == 2 else ""
        found = given.reshape(-1, 3)[row].tolist()
        raise ValueError(f"direction: {where}expected finite numbers, not all 0, got {found}")
    # Squares of the largest numbers would overflow, and those of the smallest vanish.
    scaled = given / largest
    return scaled / norm(scaled)[..., None]


@dataclass
class _MovedApart:
    """Pairs of bodies, each in bodies of its own: body 2 k stays, body 2 k + 1 is translated.

    Attributes:
        scene, still: of all bodies.
        pairs: (P, 2).
        direction: (P, 3).
        way: (P,) translations beyond which the bodies are certainly apart.
        stray: (P,) how far translated points may be from their places.
        radius: (P,) SBV radius of the smaller body; for a sphere, the radius of the sphere.
    """

    scene: Scene
    still: RigidMotion | VertexMotion
    pairs: Tensor
    direction: Tensor
    way: Tensor
    stray: Tensor
    radius: Tensor

    @classmethod
    def of(cls, bodies: MovingBodies, pairs: Tensor, direction: Tensor, separation: float) -> _MovedApart:
        """Of bodies at rest."""
        still = bodies._motion
        assert still is not None
        of_first, of_second = bodies.centre_t0[pairs].unbind(1)
        reach = bodies.reach[pairs]
        size = (reach[:, 0] + reach[:, 1]) + separation
        far = torch.maximum(bodies.centre_t0.abs(), bodies.position_t0.abs()).amax(dim=1)[pairs].amax(dim=1)
        stray = _POINTS * (far + size)
        x, y, z = (of_second - of_first).abs().unbind(1)
        way = (((x + y) + z) + (size + stray)) * (1.0 + _WAY)
        if bool((~(far + way <= arguments.LONGEST)).any()):
            row = int((far + way).argmax())
            furthest = f"reach {float((far + way)[row]):.3g}, beyond {arguments.LONGEST:g}"
            raise ValueError(f"motion: bodies {pairs[row].tolist()} would {furthest}, if they were moved apart")
        return cls(bodies.scene, still, pairs, direction, way, stray, bodies.scene._size[pairs].amin(dim=1))

    def halved(self, separation: float) -> Tensor:
        """(P,): translations at which bodies of many faces certainly touch; 0 for other bodies."""
        below, above = torch.zeros_like(self.way), self.way
        faces = self.scene.meshes.offsets.diff(dim=0)[:, 1].to(below.device)[self.scene.mesh_index.long()]
        rows = torch.nonzero(faces[self.pairs].prod(dim=1) > _FEW_FACES)[:, 0]
        for _ in range(_HALVINGS if len(rows) else 0):
            middle = 0.5 * (below + above)
            touches = torch.zeros_like(below, dtype=torch.bool)
            touches[rows] = self._touches(rows, middle[rows], separation)
            below, above = torch.where(touches, middle, below), torch.where(touches, above, middle)
        return below

    def upper(self, query: Query, below: Tensor) -> Tensor:
        """(P,): translations, not less than `below`, beyond which bodies are certainly apart."""
        rows = torch.arange(len(self.pairs), device=self.pairs.device)
        # The bodies move back from where they are apart: the first contact on that way is at the last translation that
        # touches.
        moving = MovingBodies.of(self._scene(rows, self.stray), self._motion(rows, self.way, below))
        hits = detect_moving(moving, query, pairs=self._local_pairs(rows))
        assert isinstance(hits, Contacts)
        row = hits.pairs[:, 0] // 2
        left = _above(_above(self.way - below)[row] * _above(1.0 - hits.toi))
        found = below.clone()
        found[row] = torch.where(hits.toi < 1.0, _above(below[row] + left), below[row])
        return found

    def lower(self, below: Tensor, upper: Tensor, separation: float, tolerance: float) -> Tensor:
        """(P,): translations from `below`, at which bodies touch or which is 0, to `upper`, at which they certainly
        touch. A negative tolerance is relative to the radius.
        """
        step = -tolerance * self.radius if tolerance < 0.0 else torch.full_like(self.radius, tolerance)
        step = torch.maximum(step, _WAY * self.way)
        found = below.clone()
        rows = torch.nonzero(upper - step > below)[:, 0]
        while len(rows):
            moved = (upper - step)[rows]
            touches = self._touches(rows, moved, separation)
            found[rows[touches]] = moved[touches]
            rows, step = rows[~touches], _LONGER * step
            rows = rows[(upper - step > below)[rows]]
        return found

    def _touches(self, rows: Tensor, moved: Tensor, separation: float) -> Tensor:
        """(K,) bool: whether the bodies of some of the pairs, (K,), certainly touch after translations (K,)."""
        scene, motion = self._scene(rows), self._motion(rows, moved, moved)
        pairs = self._local_pairs(rows)
        near = distance(scene, motion, cutoff=separation, pairs=pairs, tolerance=0.0)
        touches = near.upper <= separation
        # If the least distance is of triangles that only touch, other triangles may still pass through one another.
        left = torch.nonzero(~touches)[:, 0]
        if not len(left):
            return touches
        hits = detect_moving(MovingBodies.of(scene, motion), Query("all", 0.0, 0.0, False), pairs=pairs[left])
        assert isinstance(hits, Contacts)
        passes = hits[(hits.kind == Kind.EF_AB) | (hits.kind == Kind.EF_BA)]
        touches[passes.pairs[:, 0] // 2] = True
        return touches

    def _local_pairs(self, rows: Tensor) -> Tensor:
        return torch.arange(2 * len(rows), device=rows.device).view(-1, 2)

    def _scene(self, rows: Tensor, more: Tensor | None = None) -> Scene:
        """The bodies of some of the pairs, (K,), with larger margins by `more` (P,) of those that are translated."""
        picked = self.pairs[rows].reshape(-1)
        margin = self.scene.margin
        margin = None if margin is None else margin[picked]
        if more is not None:
            added = torch.stack([torch.zeros_like(more), more], 1)[rows].reshape(-1)
            margin = sum_of_margins(added, margin)
        return Scene._of_checked(self.scene.meshes, self.scene.mesh_index[picked], margin=margin)

    def _motion(self, rows: Tensor, start: Tensor, end: Tensor) -> RigidMotion | VertexMotion:
        """The bodies of some of the pairs, (K,), from a translation to another one, (K,) each."""
        shifts = [_product(moved[:, None], self.direction[rows]) for moved in (start, end)]
        picked = self.pairs[rows].reshape(-1)
        if isinstance(self.still, RigidMotion):
            first, second = self.still.position_t0[self.pairs[rows]].unbind(1)
            position = [_placed(first, second, *shift) for shift in shifts]
            turn = torch.zeros_like(position[0])
            return RigidMotion._of_checked(position[0], self.still.orientation_t0[picked], position[1], turn)
        layout = self.scene.layout
        begin = layout.vertex_begin
        count = torch.cat([begin, torch.full_like(begin[:1], layout.vertex_count)]).diff()[picked]
        within = torch.arange(int(count.sum()), device=rows.device)
        vertices = self.still.x_t0[within + (begin[picked] - (count.cumsum(0) - count)).repeat_interleave(count)]
        ends = []
        for shift, _ in shifts:
            of_bodies = torch.stack([torch.zeros_like(shift), shift], 1).reshape(-1, 3)
            ends.append(vertices + of_bodies.repeat_interleave(count, dim=0))
        return VertexMotion._of_checked(*ends)


def _above(values: Tensor) -> Tensor:
    """The next larger numbers."""
    return torch.nextafter(values, torch.full_like(values, torch.inf))


def _placed(first: Tensor, second: Tensor, shift: Tensor, rest: Tensor) -> Tensor:
    """(2 K, 3) positions of pairs of bodies at (K, 3) each, the second translated by shift + rest. Their offset is
    exact to within 2^-104 of its parts: the first body takes what rounding leaves, and the pair is near the origin.
    """
    offset, low = _sum(second, -first)
    offset, lower = _sum(offset, shift)
    return torch.stack([-((low + lower) + rest), offset], 1).reshape(-1, 3)


def _sum(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The rounded sum, and the rest: both add up to a + b exactly (Knuth)."""
    total = a + b
    of_b = total - a
    return total, (a - (total - of_b)) + (b - of_b)


def _product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The rounded product, and the rest: both add up to a b exactly (Dekker), if nothing vanishes."""
    product = a * b
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    rest = ((product - a_high * b_high) - a_low * b_high) - a_high * b_low
    return product, a_low * b_low - rest


def _halves(a: Tensor) -> tuple[Tensor, Tensor]:
    """Numbers of at most 26 bits that add up to those of `a`."""
    scaled = (2.0**27 + 1.0) * a
    high = scaled - (scaled - a)
    return high, a - high
