"""Elementary queries chosen to break collision tests; `constructed` has those whose truth is known beforehand.

Each generator takes a numpy Generator, a count and the kind. Order of the points: v, f0, f1, f2 or ea0, ea1, eb0, eb1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .constructed import (
    TOUCH,
    UNKNOWN,
    Queries,
    contact_at,
    contact_at_end,
    contact_at_start,
    disguise,
    graze,
    shared_points,
    short_of_end,
    touching_points,
)

Generator = Callable[[np.random.Generator, int, bool], Queries]


def _unknown(start: np.ndarray, end: np.ndarray, is_face: bool, name: str) -> Queries:
    n = len(start)
    return Queries(start, end, np.full(n, UNKNOWN), np.full(n, np.nan), is_face, name)


def random(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Random points: about one query in ten touches."""
    return _unknown(rng.normal(size=(n, 4, 3)), rng.normal(size=(n, 4, 3)), is_face, "random")


def coplanar(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """All points in one moving plane throughout, with few distinct coordinates so that boundaries are often hit
    exactly.
    """
    start, end = (rng.integers(-3, 4, (n, 4, 3)) * 1.0 for _ in range(2))
    start[:, :, 2] = end[:, :, 2] = 0.0
    line = np.arange(n) % 4 == 0  # and a quarter of them on one line
    start[line, :, 1] = end[line, :, 1] = 0.0
    return _unknown(*disguise(rng, start, end), is_face, "coplanar")


def parallel(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Edges stay parallel, a vertex moves within the face's plane or parallel to it."""
    start = rng.integers(-3, 4, (n, 4, 3)) * 1.0
    if is_face:
        start[:, 1:, 2], start[:, 0, 2] = 0.0, rng.integers(0, 2, n)
    else:
        start[::2, :, 2] = 0.0  # half of them in one plane, half of which stay in it
        start[:, 1] = start[:, 0] + (start[:, 3] - start[:, 2]) * rng.choice([-1.0, 0.5, 2.0], (n, 1))
    end = start.copy()
    first = slice(0, 1) if is_face else slice(0, 2)
    end[:, first] += (
        rng.integers(-4, 5, (n, 1, 3)) * np.where(np.arange(n) % 4 == 0, [[1.0], [1.0], [0.0]], 1.0).T[:, None]
    )
    if is_face:
        end[:, 0, 2] = start[:, 0, 2]
    return _unknown(*disguise(rng, start, end), is_face, "parallel")


def degenerate(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Zero-length edges, zero-area faces (on a line or in a point), at one end or at both, on a coarse grid."""
    start, end = (rng.integers(-2, 3, (n, 4, 3)) * 1.0 for _ in range(2))
    kind = np.arange(n) % 6
    for x, at in ((start, kind < 5), (end, kind != 4)):
        x[at, 3] = x[at, 2]
        point = at & (kind % 3 == 1)
        x[point, 1] = x[point, 2 if is_face else 0]
        middle = at & (kind % 3 == 2)
        if is_face:  # f2 on the line f0 f1
            x[middle, 3] = 0.5 * (x[middle, 1] + x[middle, 2])
    return _unknown(*disguise(rng, start, end), is_face, "degenerate")


def scales(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Around 1e-12 in size, around 1e8 in size, and of size 1 at 1e8 from the origin."""
    q = random(rng, n, is_face)
    factor = np.array([1e-12, 1e8, 1.0])[np.arange(n) % 3][:, None, None]
    shift = np.array([0.0, 0.0, 1e8])[np.arange(n) % 3][:, None, None]
    return _unknown(q.points_t0 * factor + shift, q.points_t1 * factor + shift, is_face, "scales")


def half_turn(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """The second primitive turned by nearly pi about an axis through its middle: on straight paths it nearly
    vanishes.
    """
    start = rng.normal(size=(n, 4, 3))
    end = start.copy()
    second = slice(1, 4) if is_face else slice(2, 4)
    middle = start[:, second].mean(axis=1, keepdims=True)
    axis = rng.normal(size=(n, 1, 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    angle = np.pi + rng.choice([0.0, 1e-12, 1e-6, 1e-3], (n, 1, 1))
    arm = start[:, second] - middle
    along = axis * (axis * arm).sum(axis=2, keepdims=True)
    end[:, second] = middle + along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(axis, arm)
    return _unknown(start, end, is_face, "half turn")


def still(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """No motion: half touch exactly, the others are random."""
    points = touching_points(rng, n, is_face, False)
    points, _ = disguise(rng, points, points)
    touching = np.arange(n) % 2 == 0
    points = np.where(touching[:, None, None], points, rng.normal(size=(n, 4, 3)))
    truth, toi = np.where(touching, TOUCH, UNKNOWN), np.where(touching, 0.0, np.nan)
    return Queries(points, points.copy(), truth, toi, is_face, "still")


def one_point(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Only one of the four points moves."""
    start = rng.normal(size=(n, 4, 3))
    end = start.copy()
    moving = rng.integers(0, 4, n)
    end[np.arange(n), moving] += 3 * rng.normal(size=(n, 3))
    return _unknown(start, end, is_face, "one point moves")


def near_miss(rng: np.random.Generator, n: int, is_face: bool) -> Queries:
    """Aimed at a boundary of the second primitive and off by 1e-15 .. 1e-6 of its size, either way."""
    points = rng.normal(size=(n, 4, 3))
    w = rng.random((n, 1))
    boundary = (1 - w) * points[:, 2] + w * points[:, 3]
    off = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-15, -6, (n, 1))
    t = rng.random((n, 1, 1))
    velocity = rng.normal(size=(n, 4, 3))
    if is_face:
        points[:, 0] = boundary + off
    else:
        along = points[:, 1] - points[:, 0]
        points[:, 0] = boundary + off
        points[:, 1] = points[:, 0] + along
    return _unknown(points - t * velocity, points + (1 - t) * velocity, is_face, "near miss")


GENERATORS: tuple[Generator, ...] = (
    random,
    contact_at,
    contact_at_start,
    contact_at_end,
    short_of_end,
    graze,
    shared_points,
    coplanar,
    parallel,
    degenerate,
    scales,
    half_turn,
    still,
    one_point,
    near_miss,
)


def everything(rng: np.random.Generator, n_each: int, is_face: bool) -> Queries:
    """All generators' queries in one."""
    made = [generator(rng, n_each, is_face) for generator in GENERATORS]
    return Queries(
        np.concatenate([q.points_t0 for q in made]),
        np.concatenate([q.points_t1 for q in made]),
        np.concatenate([q.truth for q in made]),
        np.concatenate([q.toi for q in made]),
        is_face,
        "everything",
    )
