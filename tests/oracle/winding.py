"""How often closed surfaces wind about points, by determinants in floats and, where rounding leaves a sign open, in
rational numbers.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

# (point, face) at a time, so that the tests of all faces fit into the cache.
_CHUNK = 1 << 18
# Six terms of three differences and two products each, and five sums: at most 10 roundings, of 2^-53 each.
_ROUNDING = 2.0**-49
# Covers products that underflow, of coordinates up to 1e30.
_UNDERFLOW = 1e-280


def winding_numbers(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How often closed surfaces wind about points: 0 outside; inside 1, or -1 if the triangles face inwards. Exact for
    the coordinates given.

    A ray in direction +x counts the triangles that it leaves through, less those that it enters through. It starts at
    (x, y + e, z + e^2) with an infinitely small e > 0, so it meets no vertex and no edge, and counts each point of the
    surface once.

    Args:
        points: (P, 3) float64, or fractions (dtype object); not on the surface.
        corners: (F, 3, 3) corners of the triangles.

    Returns:
        (P,) int64.
    """
    winding = np.zeros(len(points), dtype=np.int64)
    low, high = corners.min(axis=1).T, corners.max(axis=1).T
    step = max(1, _CHUNK // max(1, len(corners)))
    for begin in range(0, len(points), step):
        x, y, z = points[begin : begin + step].T[:, :, None]
        near = (x < high[0]) & (low[1] <= y) & (y < high[1]) & (low[2] <= z) & (z < high[2])
        point, face = np.nonzero(near)
        point += begin
        np.add.at(winding, point, _passes(points[point], corners[face]))
    return winding


def _passes(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,): 1 where the ray from a point leaves through the triangle, -1 where it enters, 0 where it misses it."""
    # The winding number of the triangle's boundary about the point, both seen along x: edges that pass the height of
    # the point on the side of +y. The sign of the triangle's normal along x, if the ray's line meets the triangle.
    turn = np.zeros(len(points), dtype=np.int64)
    above = corners[:, :, 2] > points[:, 2:]
    for k in range(3):
        ends = [k, (k + 1) % 3]
        rows = np.flatnonzero(above[:, ends[0]] != above[:, ends[1]])
        upwards = np.where(above[rows, ends[1]], 1, -1)
        side = _orientation(points[rows, 1:], corners[rows][:, ends, 1:])
        turn[rows] += np.where(side == upwards, upwards, 0)
    rows = np.flatnonzero(turn)
    # The line meets the triangle at x + det / (normal along x).
    turn[rows] *= _orientation(points[rows], corners[rows]) == turn[rows]
    return turn


def _orientation(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,) exact signs of det(corners - point), for d corners (n, d, d) and a point (n, d) in d = 2 or 3 dimensions."""
    sign, is_open = np.zeros(len(points), dtype=np.int64), np.ones(len(points), dtype=bool)
    if points.dtype != object:
        with np.errstate(over="ignore", invalid="ignore"):
            terms = np.stack(_terms((corners - points[:, None]).transpose(1, 2, 0)))
            value, size = terms.sum(axis=0), np.abs(terms).sum(axis=0)
            is_open = ~(np.abs(value) > _ROUNDING * size + _UNDERFLOW)
        sign[~is_open] = np.sign(value[~is_open])
    for row in np.flatnonzero(is_open).tolist():
        point, *others = ([Fraction(c) for c in x] for x in (points[row].tolist(), *corners[row].tolist()))
        exact = sum(_terms([[c - p for c, p in zip(x, point, strict=True)] for x in others]))
        sign[row] = (exact > 0) - (exact < 0)
    return sign


def _terms(matrix: Any) -> list[Any]:
    """The terms of the determinant of a 2 x 2 or 3 x 3 matrix, of numbers or of arrays."""
    if len(matrix) == 2:
        (a, b), (c, d) = matrix
        return [a * d, -b * c]
    a, b, c = matrix
    even = [a[i] * b[j] * c[k] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    return even + [-a[i] * b[j] * c[k] for i, j, k in ((0, 2, 1), (1, 0, 2), (2, 1, 0))]
