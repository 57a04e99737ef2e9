"""Translations after which convex polyhedra are apart, in exact arithmetic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import product

import numpy as np

Vector = list[Fraction]


def exactly(points: np.ndarray) -> list[Vector]:
    """Points (V, 3) of float64 as they are."""
    return [[Fraction(float(c)) for c in point] for point in np.asarray(points, dtype=np.float64).reshape(-1, 3)]


def placed(points: np.ndarray, quaternion: Sequence[float], position: Sequence[float]) -> list[Vector]:
    """Points (V, 3), turned by a quaternion (w, x, y, z), which is scaled to unit length here, then moved."""
    w, x, y, z = (Fraction(float(c)) for c in quaternion)
    square = w * w + x * x + y * y + z * z
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    shift = [Fraction(float(c)) for c in position]
    return [[_dot(row, p) / square + s for row, s in zip(rows, shift, strict=True)] for p in exactly(points)]


def meeting(
    a: list[Vector], faces_a: np.ndarray, b: list[Vector], faces_b: np.ndarray, direction: Vector
) -> tuple[Fraction, Fraction] | None:
    """The s for which the hull of `b`, translated by s times the direction, meets that of `a`; None if there is none.

    They meet unless a normal of a face, or a product of two edges, separates them.
    """
    low, high = [], []
    edges = [_edges(a, faces_a), _edges(b, faces_b)]
    normals = [*_normals(a, faces_a), *_normals(b, faces_b), *(_cross(e, f) for e, f in product(*edges))]
    for normal in _distinct(normals):
        for n in (normal, [-c for c in normal]):
            room = max(_dot(n, p) for p in a) - min(_dot(n, p) for p in b)
            speed = _dot(n, direction)
            if speed > 0:
                high.append(room / speed)
            elif speed < 0:
                low.append(room / speed)
            elif room < 0:
                return None
    first, last = max(low), min(high)
    return (first, last) if first <= last else None


def exit_of(ranges: Iterable[tuple[Fraction, Fraction] | None]) -> Fraction:
    """The last s >= 0 in any of the ranges; 0 if there is none."""
    return max([Fraction(0), *(each[1] for each in ranges if each is not None)])


def _normals(points: list[Vector], faces: np.ndarray) -> list[Vector]:
    corners = ([points[v] for v in face] for face in faces.tolist())
    return [_cross(_minus(q, p), _minus(r, p)) for p, q, r in corners]


def _edges(points: list[Vector], faces: np.ndarray) -> list[Vector]:
    ends = {(min(e), max(e)) for f in faces.tolist() for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    return _distinct(_minus(points[q], points[p]) for p, q in sorted(ends))


def _distinct(vectors: Iterable[Vector]) -> list[Vector]:
    """Lines through zero, each once, without zero vectors."""
    found = {}
    for vector in vectors:
        largest = next((c for c in vector if c != 0), None)
        if largest is not None:
            found[tuple(c / largest for c in vector)] = vector
    return list(found.values())


def _minus(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a: Sequence[Fraction], b: Sequence[Fraction]) -> Fraction:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
