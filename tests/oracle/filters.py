"""Rigorous float64 culls for primitives on straight paths: rejected ones certainly never touch.

Error model: with u = 2^-53 every operation has a relative error of at most u, or an absolute one of at most 2^-1074
where it underflows. Coordinates beyond 1e60 are never culled by the tests that multiply, so that nothing overflows,
and 1e-200 is added to every error bound, which is more than what underflow (2^-1074 times at most (4e60)^2, some
dozens of times) can add.
"""

from __future__ import annotations

import numpy as np

U = 2.0**-53
TINY = 1e-200
HUGE = 1e60
# The points of the two sets: v and f0 f1 f2, or ea0 ea1 and eb0 eb1.
FIRST = {True: [0], False: [0, 1]}
SECOND = {True: [1, 2, 3], False: [2, 3]}


def boxes_overlap(start: np.ndarray, end: np.ndarray, is_face: bool, separation: float = 0.0) -> np.ndarray:
    """(n,) bool: do the boxes of the whole motions of the two sets come within `separation`? Points (n, 4, 3)."""
    a = np.concatenate([start[:, FIRST[is_face]], end[:, FIRST[is_face]]], axis=1)
    b = np.concatenate([start[:, SECOND[is_face]], end[:, SECOND[is_face]]], axis=1)
    # Comparing doubles is exact; with a separation the one subtraction is rounded towards "may touch".
    gap = np.maximum(a.min(axis=1) - b.max(axis=1), b.min(axis=1) - a.max(axis=1))
    return (np.nextafter(gap, -np.inf) <= separation).all(axis=1)


def separated_along(
    direction: np.ndarray, start: np.ndarray, end: np.ndarray, is_face: bool, separation: float = 0.0
) -> np.ndarray:
    """(n,) bool: certain that the sets stay further apart than `separation` along an arbitrary direction (n, 3).

    The gap between a point of each set, along a fixed direction, is linear in t; if all are beyond the separation at
    both ends with one and the same sign, they are so throughout.
    """
    a0, b0 = start[:, FIRST[is_face]][:, :, None], start[:, SECOND[is_face]][:, None]
    a1, b1 = end[:, FIRST[is_face]][:, :, None], end[:, SECOND[is_face]][:, None]
    d = direction[:, None, None]
    certain = np.ones((2, len(start)), dtype=bool)
    # |direction| rounded up: 3 squares, 2 sums, a root and this product, each off by at most u.
    reach = separation * np.sqrt((direction**2).sum(axis=-1)) * (1 + 16 * U) + (TINY if separation else 0.0)
    with np.errstate(all="ignore"):
        for w in (b0 - a0, b1 - a1):
            term = w * d
            # (difference, product, two sums): 4 roundings on each term, so 8 u of the sum of magnitudes is ample.
            error = 8 * U * np.abs(term).sum(axis=-1) + TINY
            along = term.sum(axis=-1)
            certain[0] &= (along - error > reach[:, None, None] * (1 + 8 * U)).all(axis=(1, 2))
            certain[1] &= (-along - error > reach[:, None, None] * (1 + 8 * U)).all(axis=(1, 2))
    # NaN compares false; infinities are excluded here, and so are directions whose square could underflow.
    size = np.abs(direction).max(axis=1)
    in_range = (np.abs(start).max(axis=(1, 2)) < HUGE) & (np.abs(end).max(axis=(1, 2)) < HUGE)
    return certain.any(axis=0) & in_range & (size < HUGE) & (size > 1e-60)


def directions(start: np.ndarray, end: np.ndarray, is_face: bool) -> list[np.ndarray]:
    """Directions (n, 3) to try, roughly normalised: normals and lines between centres at t0, at t1 and in between."""
    found = []
    for x in (start, end, 0.5 * (start + end)):
        normal = (
            np.cross(x[:, 2] - x[:, 1], x[:, 3] - x[:, 1])
            if is_face
            else np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
        )
        found += [normal, x[:, SECOND[is_face]].mean(axis=1) - x[:, FIRST[is_face]].mean(axis=1)]
    scaled = []
    for d in found:
        with np.errstate(all="ignore"):
            scale = np.abs(d).max(axis=1, keepdims=True)
            scaled.append(np.where((scale > 0) & np.isfinite(scale), d / scale, 0.0))
    return scaled


def _triple(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Determinant and permanent of the magnitudes.
    value, size = np.zeros(len(a)), np.zeros(len(a))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        value = value + a[:, i] * (b[:, j] * c[:, k] - b[:, k] * c[:, j])
        size = size + np.abs(a[:, i]) * (np.abs(b[:, j] * c[:, k]) + np.abs(b[:, k] * c[:, j]))
    return value, size


def never_coplanar(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) bool: certain that the four points (n, 4, 3) never lie in a plane (Bernstein coefficients all of one
    sign).
    """
    with np.errstate(all="ignore"):
        ends = [[x[:, k] - x[:, 0] for k in (1, 2, 3)] for x in (start, end)]
        certain = [np.ones(len(start), dtype=bool), np.ones(len(start), dtype=bool)]
        for degree in range(4):
            total, size = np.zeros(len(start)), np.zeros(len(start))
            for code in range(8):
                which = [(code >> k) & 1 for k in range(3)]
                if sum(which) == degree:
                    value, magnitude = _triple(*(ends[w][k] for k, w in enumerate(which)))
                    total, size = total + value, size + magnitude
            # Each product passes 3 differences, 2 products and at most 7 sums: 12 u, and as much again for `size`
            # itself.
            error = 32 * U * size + TINY
            certain[0] &= total > error
            certain[1] &= total < -error
    in_range = (np.abs(start).max(axis=(1, 2)) < HUGE) & (np.abs(end).max(axis=(1, 2)) < HUGE)
    return (certain[0] | certain[1]) & in_range


def may_touch(start: np.ndarray, end: np.ndarray, is_face: bool, separation: float = 0.0) -> np.ndarray:
    """(n,) bool: False only where the primitives (points (n, 4, 3)) certainly stay further apart than `separation`."""
    keep = boxes_overlap(start, end, is_face, separation)
    left = np.flatnonzero(keep)
    if separation == 0.0 and len(left):
        keep[left] = ~never_coplanar(start[left], end[left])
        left = np.flatnonzero(keep)
    for number in range(6):
        if not len(left):
            break
        a, b = start[left], end[left]
        keep[left] = ~separated_along(directions(a, b, is_face)[number], a, b, is_face, separation)
        left = np.flatnonzero(keep)
    return keep
