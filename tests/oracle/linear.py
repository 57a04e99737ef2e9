"""Exact first touch of a vertex and a face, or of two edges, whose points move on straight lines over t in [0, 1].

Coordinates are taken as the exact rationals that the given doubles are; touching counts and [0, 1] is closed. Let T
be the set of times at which the two primitives touch. T is closed, so if it is not empty it has a least element, the
first touch.

With n the normal of the face (the cross product of the two edge directions), a quadratic in t, and C the volume
spanned by the four points, a cubic (Redon, Kheddar & Coquillart 2002): at a time with n != 0 the primitives touch iff
C = 0 and the inside conditions hold, which are signs of quartics; at a time with n = 0 the face is a segment (the
edges are parallel) and they touch iff a point lies on a segment, which is a matter of signs of quadratics.

* C not identically zero: touching implies C = 0, so the first touch is one of at most three roots.
* C identically zero (coplanar throughout): between neighbouring roots of the sign conditions' polynomials nothing
  changes, so T is a union of such open intervals and of roots; being closed, its least element is 0 or one of those
  roots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from . import filters
from .polynomial import Polynomial, Root, add, mul, roots_in_unit_interval, sub, trim

WIDTH = Fraction(1, 2**60)
Vector = tuple[Polynomial, Polynomial, Polynomial]
ZERO_TIME = Root((0, 1), 0, 0, True)


@dataclass(frozen=True)
class Hit:
    """Bracket of the first touch: toi_lower <= true time <= toi_upper, equal where the time was found exactly."""

    toi_lower: Fraction
    toi_upper: Fraction


def integer_paths(points_t0: ArrayLike, points_t1: ArrayLike, *lengths: float) -> tuple[list[Vector], list[int]]:
    """Points (k, 3) at both ends as integer vector polynomials of degree 1, all (and the lengths) times one power of
    two.
    """
    start, end = np.asarray(points_t0, dtype=np.float64), np.asarray(points_t1, dtype=np.float64)
    if start.ndim != 2 or start.shape[1] != 3 or start.shape != end.shape:
        raise ValueError(f"points must be (k, 3) at both ends, got {start.shape} and {end.shape}")
    ratios = [x.as_integer_ratio() for x in [*start.ravel().tolist(), *end.ravel().tolist(), *map(float, lengths)]]
    scale = max(denominator for _, denominator in ratios)
    integers = [numerator * (scale // denominator) for numerator, denominator in ratios]
    size = start.size
    linear = [trim([integers[i], integers[size + i] - integers[i]]) for i in range(size)]
    return [(linear[i], linear[i + 1], linear[i + 2]) for i in range(0, size, 3)], integers[2 * size :]


def minus(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2])


def dot(a: Vector, b: Vector) -> Polynomial:
    """a . b"""
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]))


def cross(a: Vector, b: Vector) -> Vector:
    """a x b"""
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def negate(p: Polynomial) -> Polynomial:
    """-p."""
    return tuple(-c for c in p)


class PointOnSegment:
    """The times at which point p lies on the segment a b, its ends included and a = b allowed."""

    def __init__(self, p: Vector, a: Vector, b: Vector) -> None:
        self.line = cross(minus(b, a), minus(p, a))  # zero iff p, a, b are collinear
        self.between = dot(minus(p, a), minus(p, b))  # not positive iff p is then between them

    def holds(self, root: Root) -> bool:
        """Exactly at this time."""
        return not any(root.sign_of(c) for c in self.line) and root.sign_of(self.between) <= 0

    def polynomials(self) -> list[Polynomial]:
        """All polynomials whose signs are used."""
        return [*self.line, self.between]


class Condition:
    """The condition that a primitive pair touches, as signs of polynomials in t; built lazily, since most pairs are
    never coplanar.
    """

    def __init__(self, paths: Sequence[Vector], is_face: bool) -> None:
        self.is_face = is_face
        self.paths = paths
        p, q, r, s = paths  # v, f0, f1, f2 or ea0, ea1, eb0, eb1
        self.normal = cross(minus(r, q), minus(s, q)) if is_face else cross(minus(q, p), minus(s, r))
        self.volume = dot(minus(p, q), self.normal) if is_face else dot(minus(r, p), self.normal)
        self._inside: list[Polynomial] | None = None
        self._points: list[PointOnSegment] | None = None

    @property
    def inside(self) -> list[Polynomial]:
        """Where n != 0 and C = 0, the primitives touch iff none of these is negative."""
        if self._inside is None:
            p, q, r, s = self.paths
            if self.is_face:  # v on the inner side of each of the three edges
                self._inside = [dot(cross(minus(b, a), minus(p, a)), self.normal) for a, b in ((q, r), (r, s), (s, q))]
            else:
                # The lines meet in one point. It is on edge a iff a0, a1 are not strictly on one side of line b, and
                # vice versa; side(a0) - side(a1) = |n|^2 > 0 gives the order.
                u, w = minus(q, p), minus(s, r)
                self._inside = [
                    dot(cross(w, minus(p, r)), self.normal),
                    negate(dot(cross(w, minus(q, r)), self.normal)),
                    negate(dot(cross(u, minus(r, p)), self.normal)),
                    dot(cross(u, minus(s, p)), self.normal),
                ]
        return self._inside

    @property
    def points(self) -> list[PointOnSegment]:
        """Where n = 0, the primitives touch iff one of these holds."""
        if self._points is None:
            p, q, r, s = self.paths
            on = ((p, q, r), (p, r, s), (p, s, q)) if self.is_face else ((p, r, s), (q, r, s), (r, p, q), (s, p, q))
            self._points = [PointOnSegment(*three) for three in on]
        return self._points

    def holds(self, root: Root) -> bool:
        """Do the primitives touch at this time, which must be one at which C = 0?"""
        if any(root.sign_of(c) for c in self.normal):
            return all(root.sign_of(c) >= 0 for c in self.inside)
        return any(point.holds(root) for point in self.points)

    def candidates(self) -> Iterator[Root]:
        """Times that include the first touch, if there is one; C = 0 at each of them. Ascending only if C is not
        zero.
        """
        if self.volume:
            yield from roots_in_unit_interval(self.volume)
            return
        yield ZERO_TIME
        changing = (
            [*self.inside, *self.normal] if any(self.normal) else [c for p in self.points for c in p.polynomials()]
        )
        for polynomial in set(changing):
            if polynomial:
                yield from roots_in_unit_interval(polynomial)


def earliest(touching: Iterable[Root], width: Fraction) -> Hit | None:
    """Bracket of the least of some times."""
    bits = max((width.denominator // width.numerator).bit_length(), 0)
    hits = list(touching)
    for root in hits:
        root.refine(bits)
    return Hit(min(r.lower for r in hits), min(r.upper for r in hits)) if hits else None


def _first_touch(points_t0: ArrayLike, points_t1: ArrayLike, is_face: bool, width: Fraction) -> Hit | None:
    paths, _ = integer_paths(points_t0, points_t1)
    condition = Condition(paths, is_face)
    touching = (root for root in condition.candidates() if condition.holds(root))
    if condition.volume:  # ascending: the first one is the earliest
        return earliest(islice(touching, 1), width)
    return earliest(touching, width)


def vertex_face(points_t0: ArrayLike, points_t1: ArrayLike, width: Fraction = WIDTH) -> Hit | None:
    """First touch of a vertex and a face. Points (4, 3) float64 in the order v, f0, f1, f2; None if they never
    touch.
    """
    return _first_touch(points_t0, points_t1, True, width)


def edge_edge(points_t0: ArrayLike, points_t1: ArrayLike, width: Fraction = WIDTH) -> Hit | None:
    """First touch of two edges. Points (4, 3) float64 in the order ea0, ea1, eb0, eb1; None if they never touch."""
    return _first_touch(points_t0, points_t1, False, width)


def vertex_face_many(points_t0: np.ndarray, points_t1: np.ndarray, width: Fraction = WIDTH) -> list[Hit | None]:
    """As `vertex_face` for points (n, 4, 3): a rigorous float filter first, exact arithmetic for the rest."""
    return _many(points_t0, points_t1, True, width)


def edge_edge_many(points_t0: np.ndarray, points_t1: np.ndarray, width: Fraction = WIDTH) -> list[Hit | None]:
    """As `edge_edge` for points (n, 4, 3): a rigorous float filter first, exact arithmetic for the rest."""
    return _many(points_t0, points_t1, False, width)


def _many(points_t0: np.ndarray, points_t1: np.ndarray, is_face: bool, width: Fraction) -> list[Hit | None]:
    start, end = np.asarray(points_t0, dtype=np.float64), np.asarray(points_t1, dtype=np.float64)
    hits: list[Hit | None] = [None] * len(start)
    for i in np.flatnonzero(filters.may_touch(start, end, is_face)):
        hits[i] = _first_touch(start[i], end[i], is_face, width)
    return hits
