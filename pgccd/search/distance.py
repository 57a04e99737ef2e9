"""Bounds of how near bodies come to one another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.contacts.contacts import Contacts, earliest_of_each
from pgccd.contacts.kinds import Kind
from pgccd.contacts.rows import Form, Rows
from pgccd.contacts.trajectories import time_along
from pgccd.geometry.scene import Scene
from pgccd.geometry.scene_columns import integer_column
from pgccd.motion.of_scene import at_start, in_scene, segments_as_step
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory
from pgccd.search import broad
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import RELATIVE_TOLERANCE, check_pairs, operator_tolerance, warn_of_rounded_positions
from pgccd.search.detect import detect_moving
from pgccd.search.query import Query


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Distances(Rows):
    """Certified bounds of the least distance of body pairs over a motion, made by `pgccd.distance`.

    Attributes:
        pairs: (K, 2) int64, i < j.
        lower: (K,) float64 >= 0, length: the surfaces are never nearer than this.
        upper: (K,) float64, length: at `time` the surfaces are at most this far apart. 0 if they intersect then, or
            touch with their margins; inf if `lower` is above the cutoff, or if the search ended before it found a
            bound.
        time: (K,) float64 in [0, 1], along the whole motion; nan where `upper` is inf. If several times and points are
            equally near within the tolerance, `time` and `points` are of any one of them.
        points: (K, 2, 3) float64, world frame: a point of the surface of i and one of j at `time`, on the meshes, not
            their margins; nan where `upper` is inf. Not certified: rounded like world coordinates. Where surfaces
            intersect, both are the same point of the intersection, up to rounding.
        converged: (K,) bool: whether `upper` - `lower` is at most the tolerance, or `lower` is above the cutoff. False
            in rows whose search stopped early, because of rounding or of its limit of work.
        inside: (K,) bool: whether a connected piece of one body is inside of the other, a solid, at the start of the
            motion or of a segment, without touching its surface. The distance is then 0, at that time, and `points` are
            those of the contact of kind `INSIDE`.

    Example:
        >>> near = pgccd.distance(scene, motion, cutoff=0.1)
        >>> clearance = min(near.lower.tolist(), default=0.1)  # of all pairs: without a row, above the cutoff
    """

    pairs: Tensor
    lower: Tensor
    upper: Tensor
    time: Tensor
    points: Tensor
    converged: Tensor
    inside: Tensor

    _names: ClassVar[tuple[str, ...]] = ("pairs", "lower", "upper", "time", "points", "converged", "inside")
    _forms: ClassVar[Mapping[str, Form]] = {
        "pairs": (torch.int64, (2,)),
        "lower": (torch.float64, ()),
        "upper": (torch.float64, ()),
        "time": (torch.float64, ()),
        "points": (torch.float64, (2, 3)),
        "converged": (torch.bool, ()),
        "inside": (torch.bool, ()),
    }

    def of_bodies(self, owner: int | Tensor | Sequence[int]) -> tuple[Tensor, Tensor]:
        """Bounds of the least distance of each body from all others; or of each group of bodies, such as a link, from
        the bodies outside of the group.

        Args:
            owner: N, the number of bodies; or (N,) integers >= 0: the group of each body.

        Returns:
            lower, upper: (G,) float64, length, by body or group. inf where no pair is listed: all other bodies that
            were asked for are further away than the cutoff.

        Raises:
            TypeError, ValueError: `owner` is neither of these, or has too few bodies for the pairs.

        Example:
            >>> near = pgccd.distance(scene, motion, cutoff=0.1)
            >>> lower, upper = near.of_bodies(scene.body_count)
        """
        device = self.pairs.device
        least = int(self.pairs.max()) + 1 if len(self) else 0
        if isinstance(owner, int):
            owner = torch.arange(arguments.integer(owner, "owner", 0, "a number of bodies >= 0"), device=device)
        group = integer_column(owner, "owner", None, device)
        if len(group) < least or bool((group < 0).any()):
            raise ValueError(f"owner: expected an integer >= 0 for each of {least} bodies or more, got {owner!r}")
        of_pairs = group[self.pairs]
        counted = of_pairs[:, 0] != of_pairs[:, 1]
        row = of_pairs[counted].T.reshape(-1)
        found = torch.full((int(group.max()) + 1 if len(group) else 0,), torch.inf, dtype=torch.float64, device=device)
        lower, upper = (
            found.scatter_reduce(0, row, bound[counted].repeat(2), "amin") for bound in (self.lower, self.upper)
        )
        return lower, upper

    def __repr__(self) -> str:
        """The number of pairs, and the bounds of the least distance of all."""
        if not len(self):
            return f"Distances(count=0, device={self.pairs.device})"
        least = f"least={float(self.lower.min()):.6g}..{float(self.upper.min()):.6g}"
        return f"Distances(count={len(self)}, {least}, device={self.pairs.device})"


def distance(
    scene: Scene,
    motion: RigidMotion | VertexMotion | Trajectory,
    *,
    cutoff: float | None = None,
    pairs: Tensor | None = None,
    tolerance: float | None = None,
) -> Distances:
    """How near bodies come to one another during a motion. Finds a lower and an upper bound of the least distance of
    their surfaces at equal times, both certified, and where and when the upper bound is attained.

    The distance is that of surfaces, less the margins of both bodies. It is 0 if they intersect or touch, not the depth
    of penetration, and 0 if a connected piece of one body is inside of the other, a solid. If the other body is no
    solid, it is the distance of both surfaces. For bodies that stand still relative to each other, as with
    `RigidMotion.at_rest`, it is the distance in their poses, to within rounding. Bodies have no distance from
    themselves.

    Args:
        scene: the bodies.
        motion: their paths; with a `Trajectory`, all of its segments.
        cutoff: length >= 0: larger distances do not matter. Required unless `pairs` are given.
        pairs: (P, 2) int64, i < j, in any order: the pairs to measure, each a row of the result. The scene's filters
            and `exclude` are not applied to them. Default: all pairs that the filters allow and that may come within
            the cutoff.
        tolerance: length: a search ends when its bounds differ by at most this, or after the work of about a second on
            a CPU. Rounding limits it to some 1e-12 of the size and offset of the bodies; see `Distances.converged`.
            Default: 1e-6 of the smaller radius of each pair, SBV radius and margin. Costs grow slowly as it decreases,
            unless bodies are equally near in very many places, such as one that turns within another.

    Returns:
        Distances, on the scene's device: a row for each of the given pairs, or for all pairs that are not certainly
        further apart than the cutoff, sorted. Synchronises with a GPU.

    Raises:
        TypeError, ValueError: naming the argument; also if neither `cutoff` nor `pairs` are given, or an input requires
            grad.

    Example:
        >>> near = pgccd.distance(scene, pgccd.RigidMotion.at_rest(x, q), cutoff=0.5)
        >>> near.pairs, near.lower, near.points
    """
    arguments.instance(scene, "scene", Scene)
    arguments.instance(motion, "motion", RigidMotion, VertexMotion, Trajectory)
    if cutoff is None and pairs is None:
        raise ValueError("cutoff: expected a length, unless pairs are given")
    limit = math.inf if cutoff is None else arguments.length(cutoff, "cutoff")
    accuracy = operator_tolerance(tolerance)
    if pairs is not None:
        pairs = check_pairs(pairs, scene, deforms=False)
    if isinstance(motion, Trajectory):
        motion._refuse_gradient()
        found = _along(scene, motion, limit, pairs, accuracy)
    else:
        found = _of_step(scene, motion, limit, pairs, accuracy)[0]
    warn_of_rounded_positions(scene, motion)
    return found


def _of_step(
    scene: Scene, motion: RigidMotion | VertexMotion, cutoff: float, pairs: Tensor | None, tolerance: float
) -> tuple[Distances, Tensor]:
    """The distances of a step, and for each row the tolerance (K,)."""
    bodies = MovingBodies.of(scene, motion)
    wanted = pairs
    if wanted is None:
        wanted = broad.find_pairs_of_checked(bodies, cutoff, broad.choose(bodies), tolerance=0.0)
        wanted = wanted[wanted[:, 0] != wanted[:, 1]]
    lower, upper, time, points = ops.distances(bodies.operands, wanted, cutoff, tolerance)
    thickness = scene._thickness
    thick = bodies.radius if thickness is None else bodies.radius + thickness
    radius = thick[wanted].amin(dim=1)
    allowed = RELATIVE_TOLERANCE * radius if tolerance < 0.0 else torch.full_like(radius, tolerance)
    inside = torch.zeros_like(lower, dtype=torch.bool)
    if scene.meshes.has_solids:
        inside, at = _inside_at_start(scene, motion, wanted)
        lower, upper, time = (torch.where(inside, 0.0, column) for column in (lower, upper, time))
        points = torch.where(inside[:, None, None], at[:, None], points)
    converged = (upper - lower <= allowed) | (lower > cutoff)
    found = Distances(
        pairs=wanted, lower=lower, upper=upper, time=time, points=points, converged=converged, inside=inside
    )
    if pairs is not None:
        return found, allowed
    near = lower <= cutoff
    return _rows(found, near), allowed[near]


def _inside_at_start(scene: Scene, motion: RigidMotion | VertexMotion, pairs: Tensor) -> tuple[Tensor, Tensor]:
    """(P,) bool: the pairs (P, 2) in which a piece of one body is inside of the other, and no surfaces touch; and a
    vertex of the piece (P, 3).
    """
    asked, row = torch.unique(pairs, dim=0, return_inverse=True)
    inside = torch.zeros_like(asked[:, 0], dtype=torch.bool)
    at = torch.zeros((len(asked), 3), dtype=torch.float64, device=pairs.device)
    hits = detect_moving(MovingBodies.of(scene, at_start(motion)), Query("first", 0.0, 0.0, False), pairs=asked)
    assert isinstance(hits, Contacts)
    hits = hits[hits.kind == Kind.INSIDE]
    place = torch.searchsorted(*(each[:, 0] * scene.body_count + each[:, 1] for each in (asked, hits.pairs)))
    inside[place], at[place] = True, hits.point
    return inside[row], at[row]


def _rows(found: Distances, rows: Tensor) -> Distances:
    return Distances(**{name: column[rows] for name, column in vars(found).items()})


def _along(scene: Scene, trajectory: Trajectory, cutoff: float, pairs: Tensor | None, tolerance: float) -> Distances:
    """The least distances of all segments, each of which is a step of copies of the bodies."""
    segments = trajectory.segment_count
    copies, steps, of_copies = segments_as_step(scene, trajectory, pairs)
    found, allowed = _of_step(copies, steps, cutoff, of_copies, tolerance)
    segment, of_scene = in_scene(found.pairs, scene.body_count)
    if pairs is None:
        pairs, owner = torch.unique(of_scene, dim=0, return_inverse=True)
    else:
        owner = torch.arange(len(pairs), device=scene.device).repeat(segments)
    least = torch.full((len(pairs),), math.inf, dtype=torch.float64, device=scene.device)
    lower = least.scatter_reduce(0, owner, found.lower, "amin")
    rows = earliest_of_each(owner, len(pairs), found.upper)
    nearest, segment = _rows(found, rows), segment[rows]
    time = torch.where(torch.isnan(nearest.time), nearest.time, time_along(segment, nearest.time, segments))
    # Searches of segments in which the bodies are further apart need not have converged.
    are_converged = least.scatter_reduce(0, owner, found.converged.to(torch.float64), "amin") > 0.0
    is_converged = are_converged | (nearest.upper - lower <= least.scatter_reduce(0, owner, allowed, "amin"))
    return Distances(
        pairs=pairs,
        lower=lower,
        upper=nearest.upper,
        time=time,
        points=nearest.points,
        converged=is_converged,
        inside=nearest.inside,
    )
