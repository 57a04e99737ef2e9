"""Rigid motions under which given features of two bodies touch or nearly touch, and the exact outcome.

The motions are chosen in floats; the outcome is then found for exactly these numbers (by `batch`, and by the
outward-rounded intervals of `rigid` for queries that it leaves undecided).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import batch, rigid
from .batch_paths import ArcPaths, Turning, first_count
from .search import CLOSE, Decisions


@dataclass(frozen=True)
class Plan:
    """How two bodies should meet; lengths in units of the features' size."""

    turn: Callable[[np.random.Generator, int], np.ndarray]  # (n,) radians per step
    travel: float = 1.0
    boundary: bool = False  # meet on a boundary of both features
    graze: bool = False  # no velocity along the common normal
    off: tuple[float, float] | None = None  # then miss by 10^-a .. 10^-b, on either side
    pass_by: bool = False  # pass at the distance given by the caller instead of meeting
    aimed: bool = True
    shift: float = 0.0  # of both bodies, from the world's origin


def _up_to(most: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    return lambda rng, n: most * rng.random(n)


PLANS = {
    "random": Plan(_up_to(2.0), aimed=False),
    "meeting": Plan(_up_to(1.0)),
    "boundaries": Plan(_up_to(1.0), boundary=True, off=(10.0, 1.0)),
    "grazing": Plan(_up_to(2.0), graze=True, off=(9.0, 2.0)),
    "small turns": Plan(lambda rng, n: 10.0 ** -rng.uniform(2, 12, n), off=(10.0, 1.0)),
    "passing": Plan(_up_to(2.0), graze=True, pass_by=True),
    "half turns": Plan(lambda rng, n: np.pi + rng.choice([0.0, 1e-15, -1e-9, 1e-3], n)),
    "many turns": Plan(_up_to(40.0)),
    "no turn": Plan(lambda rng, n: np.zeros(n)),
    "fast": Plan(_up_to(3.0), travel=1e6),
    "far away": Plan(_up_to(1.0), shift=1e8),
}


def _directions(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _weights(rng: np.random.Generator, n: int, is_face: bool, boundary: bool) -> np.ndarray:
    """(n, 4): weights of the four points for a point on each primitive."""
    u, v = rng.uniform(0.02, 0.98, (2, n))
    if boundary:  # a quarter each: edges' interiors and ends
        u, v = np.where(rng.random(n) < 0.5, np.round(u), u), np.where(rng.random(n) < 0.5, np.round(v), v)
    if not is_face:
        return np.stack([1 - u, u, 1 - v, v], axis=1)
    v = v * (1 - u)
    if boundary:
        v = np.where(rng.random(n) < 0.5, 0.0, 1 - u)
    return np.stack([np.ones(n), 1 - u - v, u, v], axis=1)


def _turned(points: np.ndarray, body: Turning, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, k, 3) of a body at times (n,), relative to its centre, and their velocities."""
    s, u = body.orientation_t0[:, None, :1], body.orientation_t0[:, None, 1:]
    x = points + 2 * np.cross(u, np.cross(u, points) + s * points)
    w = body.rotation[:, None]
    angle = np.linalg.norm(w, axis=2, keepdims=True)
    axis = w / np.maximum(angle, 1e-300)
    along = axis * (axis * x).sum(axis=2, keepdims=True)
    now = angle * t[:, None, None]
    x = along + np.cos(now) * (x - along) + np.sin(now) * np.cross(axis, x)
    return x, np.cross(w, x)


def motions(
    rng: np.random.Generator, plan: Plan, points: np.ndarray, is_face: bool, size: float, clearance: float = 0.0
) -> tuple[Turning, Turning]:
    """Motions of the bodies of the first and the second primitive; points (n, 4, 3) in their frames.

    `clearance`: the distance at which they pass, if the plan is to pass by.
    """
    n, count = len(points), first_count(is_face)
    quaternions = rng.normal(size=(2, n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=2, keepdims=True)
    spins = [plan.turn(rng, n)[:, None] * _directions(rng, n) for _ in range(2)]
    still = np.zeros((n, 3))
    bodies = [Turning(still, q, still, w) for q, w in zip(quaternions, spins, strict=True)]
    t = rng.random(n)
    (x, vx), (y, vy) = (_turned(p, b, t) for p, b in zip((points[:, :count], points[:, count:]), bodies, strict=True))
    weights = _weights(rng, n, is_face, plan.boundary)[:, :, None]
    a, b = weights[:, :count], weights[:, count:]
    apart = (a * x).sum(axis=1) - (b * y).sum(axis=1)  # offset of the second centre from the first at the meeting time
    speed = (a * vx).sum(axis=1) - (b * vy).sum(axis=1)
    edge = y[:, 1] - y[:, 0]
    normal = np.cross(edge, y[:, 2] - y[:, 0]) if is_face else np.cross(x[:, 1] - x[:, 0], edge)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    way = [plan.travel * size * rng.normal(size=(n, 3)) * rng.random((n, 1)) for _ in range(2)]
    if plan.graze:
        way[1] = way[1] + normal * ((speed + way[0] - way[1]) * normal).sum(axis=1, keepdims=True)
    if plan.off is not None:
        miss = size * 10.0 ** -rng.uniform(plan.off[1], plan.off[0], (n, 1)) * rng.choice([-1.0, 1.0], (n, 1))
        apart = apart + miss * (normal if plan.graze else _directions(rng, n))
    if plan.pass_by:
        apart = apart + clearance * normal
    if not plan.aimed:
        apart = 2 * size * rng.normal(size=(n, 3))
    first = size * (rng.normal(size=(n, 3)) + plan.shift)
    second = first + t[:, None] * way[0] + apart - t[:, None] * way[1]
    starts = (first, second)
    placed = [Turning(p, b.orientation_t0, p + v, b.rotation) for p, v, b in zip(starts, way, bodies, strict=True)]
    return placed[0], placed[1]


def decide(
    points: np.ndarray, first: Turning, second: Turning, is_face: bool, separation: float = 0.0
) -> tuple[Decisions, np.ndarray]:
    """Decides every query, points (n, 4, 3) in body frames; and returns which (n,) the batch oracle left to the
    intervals.
    """
    found = batch.first_within(ArcPaths(points, first, second, is_face), separation)
    asked = found.status == CLOSE
    rows = np.flatnonzero(asked)
    if len(rows):
        bodies = [
            rigid.BodyMotion.from_rotation(
                b.position_t0[rows], b.orientation_t0[rows], b.position_t1[rows], b.rotation[rows]
            )
            for b in (first, second)
        ]
        method = rigid.vertex_face if is_face else rigid.edge_edge
        again = method(points[rows], bodies[0], bodies[1], separation)
        better = again.status != CLOSE
        for column, value in (
            (found.status, again.status),
            (found.toi_lower, again.toi_lower),
            (found.toi_upper, again.toi_upper),
        ):
            column[rows[better]] = value[better]
    return found, asked
