"""Exact first time at which two primitives on straight paths come within a minimum separation (distance <= separation).

The distance is within s iff one of these pieces holds (see `distance`), each a conjunction of signs of polynomials in
t: point-point |p - q|^2 <= s^2; point-edge with the foot on a proper edge; point-face or edge-edge with the feet inside
and the common normal n != 0, C^2 <= s^2 |n|^2. Let tau be the first such time. If tau > 0, the distance is exactly s at
tau (it is continuous), so some piece holds there with equality: tau is a root of that piece's distance polynomial, or,
where that polynomial vanishes identically, a time at which that piece starts to hold, hence a root of one of its other
polynomials. So it suffices to test every piece at t = 0 and at its own roots. There is no rounding, so no query is
undecided.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from . import filters
from .interval import Interval
from .linear import WIDTH, ZERO_TIME, Condition, Hit, Vector, cross, dot, earliest, integer_paths, minus
from .polynomial import Polynomial, Root, mul, roots_in_unit_interval, sub
from .search import least_distance


@dataclass(frozen=True)
class Piece:
    """Holds iff excess <= 0, every polynomial of `inside` >= 0 and `proper` > 0 (each a function of t)."""

    excess: Polynomial
    inside: tuple[Polynomial, ...] = ()
    proper: Polynomial = (1,)

    def holds(self, root: Root) -> bool:
        """Exactly at this time."""
        return (
            root.sign_of(self.excess) <= 0
            and root.sign_of(self.proper) > 0
            and all(root.sign_of(p) >= 0 for p in self.inside)
        )

    def touching(self) -> Iterator[Root]:
        """Times at which it holds, among them its first, unless the distance was already smaller at t = 0."""
        if self.holds(ZERO_TIME):
            yield ZERO_TIME
        for p in {self.excess} if self.excess else {self.proper, *self.inside}:
            if p:
                yield from (root for root in roots_in_unit_interval(p) if self.holds(root))


def _pieces(paths: list[Vector], square: Polynomial, is_face: bool) -> Iterator[Piece]:
    def point_point(p: Vector, q: Vector) -> Piece:
        return Piece(sub(dot(minus(p, q), minus(p, q)), square))

    def point_edge(p: Vector, a: Vector, b: Vector) -> Piece:
        e, away = minus(b, a), cross(minus(b, a), minus(p, a))
        length = dot(e, e)
        return Piece(
            sub(dot(away, away), mul(square, length)), (dot(minus(p, a), e), dot(minus(b, p), e)), proper=length
        )

    p, q, r, s = paths
    for a in (p,) if is_face else (p, q):
        for b in (q, r, s) if is_face else (r, s):
            yield point_point(a, b)
    if is_face:
        yield from (point_edge(p, a, b) for a, b in ((q, r), (r, s), (s, q)))
    else:
        yield from (point_edge(*three) for three in ((p, r, s), (q, r, s), (r, p, q), (s, p, q)))
    condition = Condition(paths, is_face)
    size = dot(condition.normal, condition.normal)
    excess = sub(mul(condition.volume, condition.volume), mul(square, size))
    # The inside signs of the touching test see only the projection along n, so they hold for the feet too.
    yield Piece(excess, tuple(condition.inside), proper=size)


def _first_within(
    points_t0: ArrayLike, points_t1: ArrayLike, separation: float, is_face: bool, width: Fraction
) -> Hit | None:
    if not separation >= 0:
        raise ValueError(f"separation must not be negative, got {separation}")
    paths, (length,) = integer_paths(points_t0, points_t1, separation)
    square: Polynomial = (length * length,) if length else ()
    found: list[Root] = []
    for piece in _pieces(paths, square, is_face):
        for root in piece.touching():
            if root is ZERO_TIME:
                return Hit(Fraction(0), Fraction(0))
            found.append(root)
    return earliest(found, width)


def vertex_face_within(
    points_t0: ArrayLike, points_t1: ArrayLike, separation: float, width: Fraction = WIDTH
) -> Hit | None:
    """First time with distance <= separation; points (4, 3) in the order v, f0, f1, f2. None if there is none."""
    return _first_within(points_t0, points_t1, separation, True, width)


def edge_edge_within(
    points_t0: ArrayLike, points_t1: ArrayLike, separation: float, width: Fraction = WIDTH
) -> Hit | None:
    """First time with distance <= separation; points (4, 3) in the order ea0, ea1, eb0, eb1. None if there is none."""
    return _first_within(points_t0, points_t1, separation, False, width)


def within_many(
    points_t0: np.ndarray, points_t1: np.ndarray, separation: float, is_face: bool, width: Fraction = WIDTH
) -> list[Hit | None]:
    """The same for points (n, 4, 3): a rigorous float filter first, exact arithmetic for the rest."""
    start, end = np.asarray(points_t0, dtype=np.float64), np.asarray(points_t1, dtype=np.float64)
    hits: list[Hit | None] = [None] * len(start)
    for i in np.flatnonzero(filters.may_touch(start, end, is_face, separation)):
        hits[i] = _first_within(start[i], end[i], separation, is_face, width)
    return hits


def touches_within(points_t0: ArrayLike, points_t1: ArrayLike, separation: float, is_face: bool) -> str:
    """'yes' or 'no', exactly; 'too close to call', as in `rigid`, does not occur on straight paths."""
    return "no" if _first_within(points_t0, points_t1, separation, is_face, WIDTH) is None else "yes"


class LinearPaths:
    """Points (n, 4, 3) on straight paths, relative to the second point as it moves, for `search`."""

    def __init__(self, points_t0: np.ndarray, points_t1: np.ndarray, is_face: bool) -> None:
        self.is_face = is_face
        start, end = (np.asarray(x, dtype=np.float64).reshape(-1, 4, 3) for x in (points_t0, points_t1))
        self.offset = Interval(start) - start[:, 1:2]
        self.step = (Interval(end) - end[:, 1:2]) - self.offset
        self.jerk = np.zeros(start.shape[:2])

    def derivatives(self, query: np.ndarray, t: np.ndarray) -> tuple[Interval, Interval, Interval]:
        """Enclosures (k, 4, 3) of positions, velocities and accelerations of queries (k,) at the times (k,)."""
        step = self.step[query]
        return self.offset[query] + step * t[:, None, None], step, Interval(np.zeros_like(step.lo))


def closest_approach(
    points_t0: np.ndarray,
    points_t1: np.ndarray,
    is_face: bool,
    t_from: float = 0.0,
    t_to: float = 1.0,
    width: float = 1e-12,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lower, upper, time), each (n,): proven bracket of the least distance over [t_from, t_to] and where it is
    attained.

    Points (n, 4, 3) or (4, 3). `width`, the intended width of the bracket, is relative to the size of the query (its
    largest coordinate relative to the second point); rounding or a limit of effort may leave it wider.
    """
    return least_distance(LinearPaths(points_t0, points_t1, is_face), t_from, t_to, width)
