"""Elementary queries whose truth is known by construction.

All coordinates are small dyadic numbers, so that every sum below is exact in float64 and the stored points are exact.
Order of the points: v, f0, f1, f2 or ea0, ea1, eb0, eb1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

UNKNOWN, FREE, TOUCH = -1, 0, 1


@dataclass(frozen=True)
class Queries:
    """points (n, 4, 3) at both ends, truth (n,) of UNKNOWN / FREE / TOUCH, toi (n,) nan where not known."""

    points_t0: np.ndarray
    points_t1: np.ndarray
    truth: np.ndarray
    toi: np.ndarray
    is_face: bool
    name: str


def dyadic(rng: np.random.Generator, low: float, high: float, shape: tuple[int, ...], bits: int = 4) -> np.ndarray:
    """Random multiples of 2^-bits in [low, high]."""
    return rng.integers(int(low * 2**bits), int(high * 2**bits) + 1, shape) / 2.0**bits


def disguise(rng: np.random.Generator, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Permute and mirror the axes, scale by a power of two and add a common straight motion, all exactly."""
    n = len(start)
    order = np.argsort(rng.random((n, 3)), axis=1)[:, None]
    both = np.take_along_axis(np.concatenate([start, end], axis=1), order, axis=2)
    both = both * rng.choice([-1.0, 1.0], (n, 1, 3)) * 2.0 ** rng.integers(-20, 21, (n, 1, 1))
    size = 2.0 ** np.ceil(np.log2(np.abs(both).max(axis=(1, 2), keepdims=True)))
    drift = np.repeat(dyadic(rng, -4, 4, (n, 2, 3)) * size, 4, axis=1)
    both = both + drift
    return both[:, :4], both[:, 4:]


def touching_points(rng: np.random.Generator, n: int, is_face: bool, on_boundary: bool) -> np.ndarray:
    """(n, 4, 3): points in the plane z = 0 that touch, in their insides or (`on_boundary`) on a boundary, exactly."""
    points = np.zeros((n, 4, 3))
    if is_face:
        points[:, 1:, :2] = np.array([[-2, -2], [3, -1], [0, 3]]) + dyadic(rng, -0.5, 0.5, (n, 3, 2))
        u = dyadic(rng, 0.125, 0.5, (n,))
        v = np.where(on_boundary, 0.0, dyadic(rng, 0.125, 0.375, (n,)))
        e, f = points[:, 2] - points[:, 1], points[:, 3] - points[:, 1]
        points[:, 0] = points[:, 1] + u[:, None] * e + v[:, None] * f
    else:
        points[:, 2:, :2] = np.array([[-2, -1], [2, 1]]) + dyadic(rng, -0.5, 0.5, (n, 2, 2))
        u = np.where(on_boundary, 0.0, dyadic(rng, 0.25, 0.75, (n,)))
        w = dyadic(rng, 0.25, 0.75, (n,))
        meet = points[:, 2] + w[:, None] * (points[:, 3] - points[:, 2])
        along = np.array([-1.0, 2.0, 0.0]) + np.pad(dyadic(rng, -0.25, 0.25, (n, 2)), ((0, 0), (0, 1)))
        points[:, 0], points[:, 1] = meet - u[:, None] * along, meet + (1 - u[:, None]) * along
    return points


def contact_at(rng: np.random.Generator, n: int, is_face: bool, when: float | None = None) -> Queries:
    """The first primitive passes straight through the second, at a dyadic time (or exactly at `when`), half on a
    boundary.
    """
    points = touching_points(rng, n, is_face, False)
    boundary = touching_points(rng, n, is_face, True)
    points = np.where((np.arange(n) % 2 == 1)[:, None, None], boundary, points)
    toi = rng.integers(1, 32, n) / 32.0 if when is None else np.full(n, when)
    speed = dyadic(rng, 1, 3, (n,))
    first = slice(0, 1) if is_face else slice(0, 2)
    start, end = points.copy(), points.copy()
    start[:, first, 2] -= (speed * toi)[:, None]
    end[:, first, 2] += (speed * (1 - toi))[:, None]
    start, end = disguise(rng, start, end)
    return Queries(start, end, np.full(n, TOUCH), toi, is_face, f"contact at {'some time' if when is None else when}")


def contact_at_start(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Touching exactly at t = 0, then separating."""
    return contact_at(rng, n, is_face, 0.0)


def contact_at_end(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Touching exactly at t = 1 and not before."""
    return contact_at(rng, n, is_face, 1.0)


def short_of_end(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Stops 2^-30 short of touching."""
    q = contact_at(rng, n, is_face, 1.0)
    points = touching_points(rng, n, is_face, False)
    start, end = points.copy(), points.copy()
    first = slice(0, 1) if is_face else slice(0, 2)
    start[:, first, 2] -= 2.0
    end[:, first, 2] -= 2.0**-30
    start, end = disguise(rng, start, end)
    return Queries(start, end, np.full(n, FREE), q.toi * np.nan, is_face, "short of the end")


def graze(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Surfaces graze at t = c: the gap is (t - c)^2 + e, with e = 0 (touch at c), 2^-30 (free) or -2^-30 (touch)."""
    c = rng.integers(4, 29, n) / 32.0
    gap = rng.choice([0.0, 2.0**-30, -(2.0**-30)], n)
    ends = []
    for t in (0.0, 1.0):
        s, points = t - c, np.zeros((n, 4, 3))
        if is_face:  # the rotating plane z = s x, and a vertex at (s, 0, -e)
            points[:, 0, 0], points[:, 0, 2] = s, -gap
            points[:, 1] = np.stack([np.full(n, -2.0), np.full(n, -2.0), -2 * s], axis=1)
            points[:, 2] = np.stack([np.full(n, 2.0), np.full(n, -2.0), 2 * s], axis=1)
            points[:, 3, 1] = 2.0
        else:  # the rotating line z = s y at x = 0, and an edge along x at y = s, z = -e
            points[:, 0] = np.stack([np.full(n, -2.0), s, -gap], axis=1)
            points[:, 1] = np.stack([np.full(n, 2.0), s, -gap], axis=1)
            points[:, 2, 1:] = np.stack([np.full(n, -2.0), -2 * s], axis=1)
            points[:, 3, 1:] = np.stack([np.full(n, 2.0), 2 * s], axis=1)
        ends.append(points)
    truth = np.where(gap > 0, FREE, TOUCH)
    toi = np.where(gap > 0, np.nan, np.where(gap == 0, c, c - 2.0**-15))
    start, end = disguise(rng, *ends)
    return Queries(start, end, truth, toi, is_face, "graze")


def shared_points(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """One or two points of one primitive are points of the other throughout: touching at t = 0."""
    start, end = rng.normal(size=(n, 4, 3)), rng.normal(size=(n, 4, 3))
    for x in (start, end):
        x[:, 0] = x[:, 2]
        if not is_face:
            x[n // 2 :, 1] = x[n // 2 :, 3]
    return Queries(start, end, np.full(n, TOUCH), np.zeros(n), is_face, "shared points")
