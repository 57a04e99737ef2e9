"""Distance between a vertex and a face or between two edges, at one time: float64 for many, exact or mpmath for one.

Points are in the order v, f0, f1, f2 or ea0, ea1, eb0, eb1. The least distance is attained between a pair of features
(point-point, point-edge, and point-face or edge-edge where the feet of the common normal are inside), so it is the
least over all such pairs (Ericson 2005, Real-Time Collision Detection, ch. 5, by exhaustion).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np
from numpy.typing import ArrayLike


def _clamped_foot(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n,): parameter in [0, 1] of the point of the segment a b nearest to p, in floats."""
    e = b - a
    with np.errstate(all="ignore"):
        s = ((p - a) * e).sum(axis=-1) / (e * e).sum(axis=-1)
    return np.clip(np.where(np.isfinite(s), s, 0.0), 0.0, 1.0)


def closest_coordinates(points: np.ndarray, is_face: bool) -> np.ndarray:
    """(n, 2) float64: (u, v) of approximately the closest points, always on the primitives. Points (n, 4, 3).

    Face: f0 + u (f1 - f0) + v (f2 - f0) with u, v >= 0 and u + v <= 1. Edges: ea0 + u (ea1 - ea0), eb0 + v (eb1 - eb0).
    """
    p, q, r, s = (points[:, k] for k in range(4))
    zero, one = np.zeros(len(points)), np.ones(len(points))
    if is_face:
        on = [_clamped_foot(p, q, r), _clamped_foot(p, q, s), _clamped_foot(p, r, s)]
        options = [(on[0], zero), (zero, on[1]), (1.0 - on[2], on[2])]
        e, f, g = r - q, s - q, p - q
    else:
        options = [(zero, _clamped_foot(p, r, s)), (one, _clamped_foot(q, r, s))]
        options += [(_clamped_foot(r, p, q), zero), (_clamped_foot(s, p, q), one)]
        e, f, g = q - p, r - s, r - p  # ea0 + u e + v f - eb0 = 0 in the common plane
    with np.errstate(all="ignore"):
        n = np.cross(e, f)
        square = (n * n).sum(axis=1)
        u, v = (np.cross(g, f) * n).sum(axis=1) / square, (np.cross(e, g) * n).sum(axis=1) / square
        inside = (u >= 0) & (v >= 0) & ((u + v <= 1) if is_face else ((u <= 1) & (v <= 1)))
    options.append((np.where(inside, u, zero), np.where(inside, v, zero)))
    coordinates = np.stack([np.stack(o, axis=1) for o in options])
    if is_face:  # u + v <= 1 exactly: fl(1 - u) may be half an ulp above 1 - u
        total = coordinates.sum(axis=-1) >= 1.0
        limit = np.maximum(np.nextafter(1.0 - coordinates[..., 0], -1.0), 0.0)
        coordinates[..., 1] = np.where(total, np.minimum(coordinates[..., 1], limit), coordinates[..., 1])
    distances = np.stack([np.linalg.norm(gap_vector(points, c, is_face), axis=1) for c in coordinates])
    return coordinates[np.argmin(distances, axis=0), np.arange(len(points))]


def gap_vector(points: Any, coordinates: Any, is_face: bool) -> Any:
    """(n, 3): from the point of the first primitive to that of the second at the coordinates (n, 2). Floats or
    Interval.
    """
    u, v = coordinates[:, :1], coordinates[:, 1:]
    p, q, r, s = (points[:, k] for k in range(4))
    if is_face:
        return (q - p) + (r - q) * u + (s - q) * v
    return (r - p) + (s - r) * v - (q - p) * u


def min_distance_at(points_t0: ArrayLike, points_t1: ArrayLike, t: ArrayLike, is_face: bool) -> np.ndarray:
    """(n,) float64 distances at times t (n,) or scalar on straight paths; points (n, 4, 3) or (4, 3) at both ends.

    The largest error seen is about 1e-15 times the largest coordinate difference among the eight points, for features
    that are not needle-like (length ratio below 1e4); it is an upper bound up to the same rounding in every case. Use
    `squared_distance_exact` where it matters.
    """
    start, end = np.asarray(points_t0, dtype=np.float64), np.asarray(points_t1, dtype=np.float64)
    start, end = start.reshape(-1, 4, 3), end.reshape(-1, 4, 3)
    time = np.broadcast_to(np.asarray(t, dtype=np.float64), len(start))[:, None, None]
    # Relative to a moving point: only differences, each rounded once, are used.
    a, b = start - start[:, 1:2], end - end[:, 1:2]
    points = a * (1.0 - time) + b * time
    return np.linalg.norm(gap_vector(points, closest_coordinates(points, is_face), is_face), axis=1)


def squared_distance(points: Sequence[Sequence[Any]], is_face: bool) -> Any:
    """Squared distance of points (4)(3) of any exact or multiprecision number type."""

    def minus(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
        return [x - y for x, y in zip(a, b, strict=True)]

    def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def to_segment(p: Sequence[Any], a: Sequence[Any], b: Sequence[Any]) -> Any:
        e, g = minus(b, a), minus(p, a)
        along, square = dot(e, g), dot(e, e)
        if along <= 0:
            return dot(g, g)
        if along >= square:
            return dot(minus(p, b), minus(p, b))
        away = cross(e, g)
        return dot(away, away) / square

    p, q, r, s = points
    if is_face:
        found = [to_segment(p, q, r), to_segment(p, r, s), to_segment(p, s, q)]
        n, g = cross(minus(r, q), minus(s, q)), minus(p, q)
        sides = [dot(cross(minus(b, a), minus(p, a)), n) for a, b in ((q, r), (r, s), (s, q))]
    else:
        found = [to_segment(p, r, s), to_segment(q, r, s), to_segment(r, p, q), to_segment(s, p, q)]
        e, f, g = minus(q, p), minus(s, r), minus(r, p)
        n = cross(e, f)
        u, v = dot(cross(g, f), n), dot(cross(g, e), n)
        sides = [u, v, dot(n, n) - u, dot(n, n) - v]
    square = dot(n, n)
    if square > 0 and all(side >= 0 for side in sides):
        found.append(dot(g, n) ** 2 / square)
    return min(found)


def squared_distance_exact(points_t0: ArrayLike, points_t1: ArrayLike, t: Fraction | float, is_face: bool) -> Fraction:
    """Exact squared distance at one time on straight paths; points (4, 3) at both ends."""
    start, end = np.asarray(points_t0, dtype=np.float64).tolist(), np.asarray(points_t1, dtype=np.float64).tolist()
    time = Fraction(t)
    points = [
        [Fraction(x) * (1 - time) + Fraction(y) * time for x, y in zip(a, b, strict=True)]
        for a, b in zip(start, end, strict=True)
    ]
    return Fraction(squared_distance(points, is_face))


def distance_high_precision(points: Sequence[Sequence[Any]], is_face: bool, digits: int = 50) -> mpmath.mpf:
    """Distance of points (4)(3), of numbers mpmath understands, with about `digits` digits carried."""
    with mpmath.workdps(digits):
        return mpmath.sqrt(squared_distance([[mpmath.mpf(x) for x in p] for p in points], is_face))
