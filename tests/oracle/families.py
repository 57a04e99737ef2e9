"""Generators of elementary queries of about unit size, most of them with an exactly known result.

Known ones have dyadic coordinates of few digits: every sum below is exact, in float32 too if `bits` (the digits of a
coordinate) allows it. Order of the points: v, f0, f1, f2 or ea0, ea1, eb0, eb1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import adversarial
from .constructed import dyadic, touching_points


@dataclass(frozen=True)
class Family:
    """points (n, 4, 3) at both ends; toi (n,): the first touch, infinite if there is none, nan where not known.

    Touching means a distance of at most `separation`. Where the family depends on the tolerance, it names it.
    """

    points_t0: np.ndarray
    points_t1: np.ndarray
    toi: np.ndarray
    separation: float = 0.0
    tolerance: float | None = None


Maker = Callable[[np.random.Generator, int, bool, int], Family]
NEVER = np.inf


def _first(is_face: bool) -> slice:
    return slice(0, 1) if is_face else slice(0, 2)


def _disguised(
    rng: np.random.Generator, start: np.ndarray, end: np.ndarray, is_face: bool, slant: bool = True
) -> np.ndarray:
    """(2, n, 4, 3): axes permuted and mirrored and corners renumbered; if `slant`, sheared (which keeps touches, but no
    distances) and with a common motion added; all exactly.
    """
    n = len(start)
    if slant:
        both, turn = np.stack([start, end]), rng.integers(0, 3)
        for k in range(3):
            to, by = (turn + k) % 3, (turn + k + 1) % 3
            both[..., to] += rng.choice([-1.0, -0.5, 0.0, 0.5, 2.0], (n, 1)) * both[..., by]
        start, end = both + dyadic(rng, -4, 4, (2, n, 1, 3))
    order = np.argsort(rng.random((n, 3)), axis=1)[None, :, None]
    both = np.take_along_axis(np.stack([start, end]), order, axis=3) * rng.choice([-1.0, 1.0], (n, 1, 3))
    if is_face:
        names = np.concatenate([np.zeros((n, 1), int), 1 + np.argsort(rng.random((n, 3)), axis=1)], axis=1)
    else:
        names = np.array([[0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2], [3, 2, 1, 0], [2, 3, 0, 1]])[rng.integers(0, 5, n)]
    both = np.take_along_axis(both, names[None, :, :, None], axis=2)
    return both


def _passing(
    rng: np.random.Generator,
    points: np.ndarray,
    velocity: np.ndarray,
    toi: np.ndarray,
    is_face: bool,
    slant: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    # The second primitive rests; the first is at `points` at toi.
    start, end = points.copy(), points.copy()
    start[:, _first(is_face)] -= toi[:, None, None] * velocity[:, None]
    end[:, _first(is_face)] += (1.0 - toi)[:, None, None] * velocity[:, None]
    start, end = _disguised(rng, start, end, is_face, slant)
    return start, end


def _times(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) dyadic: a quarter of them 0, a quarter 1."""
    return np.where(rng.random(n) < 0.5, rng.integers(1, 32, n), rng.choice([0, 32], n)) / 32.0


def _velocity(rng: np.random.Generator, n: int, axis: int) -> np.ndarray:
    """(n, 3) dyadic, and along an axis 1/16 at least."""
    v = dyadic(rng, -3, 3, (n, 3))
    v[:, axis] = dyadic(rng, 0.0625, 3, (n,))
    return v


def crossing(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Straight through, at a dyadic time, half of them on a boundary."""
    boundary = (np.arange(n) % 2 == 0)[:, None, None]
    points = np.where(boundary, touching_points(rng, n, is_face, True), touching_points(rng, n, is_face, False))
    toi, velocity = _times(rng, n), _velocity(rng, n, 2)
    return Family(*_passing(rng, points, velocity, toi, is_face), toi)


def fast(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """The same, moving by a million times the size (in few bits: some fifty times)."""
    points, toi = touching_points(rng, n, is_face, False), _times(rng, n)
    velocity = _velocity(rng, n, 2) * 2.0 ** (20 if bits > 24 else 6)
    return Family(*_passing(rng, points, velocity, toi, is_face), toi)


def short(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Stops just before touching."""
    points = touching_points(rng, n, is_face, False)
    gap = 2.0 ** -rng.integers(4, 12 if bits <= 24 else 40, n)
    start, end = points.copy(), points.copy()
    start[:, _first(is_face), 2] -= 2.0
    end[:, _first(is_face), 2] -= gap[:, None]
    start, end = _disguised(rng, start, end, is_face)
    return Family(start, end, np.full(n, NEVER))


def still(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """No relative motion: half touch, half are just apart."""
    points = touching_points(rng, n, is_face, False)
    gap = np.where(np.arange(n) % 2 == 0, 0.0, 2.0 ** -rng.integers(4, 12 if bits <= 24 else 40, n))
    points[:, _first(is_face), 2] += gap[:, None]
    start, end = _disguised(rng, points, points, is_face, bool(rng.integers(0, 2)))
    return Family(start, end, np.where(gap > 0, NEVER, 0.0))


def graze(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """The surfaces graze at t = c: the gap is (t - c)^2 + e, with e = 0, e > 0 (free) or e < 0 (touch)."""
    c = rng.integers(4, 29, n) / 32.0
    root = 2.0 ** -rng.integers(4, 6 if bits <= 24 else 20, n)  # of |e|
    sign = rng.integers(-1, 2, n)
    e = sign * root * root
    two, zero, ends = np.full(n, 2.0), np.zeros(n), []
    for t in (0.0, 1.0):
        s = t - c
        if is_face:  # the rotating plane z = s x, and a vertex at (s, 0, -e)
            columns = [(s, zero, -e), (-two, -two, -2 * s), (two, -two, 2 * s), (zero, two, zero)]
        else:  # the rotating line z = s y at x = 0, and an edge along x at y = s, z = -e
            columns = [(-two, s, -e), (two, s, -e), (zero, -two, -2 * s), (zero, two, 2 * s)]
        ends.append(np.array(columns).transpose(2, 0, 1))
    start, end = _disguised(rng, *ends, is_face)
    return Family(start, end, np.where(sign > 0, NEVER, np.where(sign < 0, c - root, c)))


def _facing(rng: np.random.Generator, n: int, is_face: bool) -> np.ndarray:
    """(n, 4, 3): the first primitive in x <= 0, the second in x >= 0, which meet in the plane x = 0 in one point.

    Of the second primitive a corner, a boundary's inside, or all of it lies in that plane; of the first, an end, or for
    an eighth all of it.
    """
    points = dyadic(rng, -2, 2, (n, 4, 3))
    near, far = dyadic(rng, 0.125, 2, (n,)), dyadic(rng, 0.125, 2, (n,))
    kind = rng.integers(0, 3, n)
    points[:, 0, 0] = 0.0
    if not is_face:
        points[:, 1, 0] = np.where(rng.integers(0, 8, n) == 0, 0.0, -near)
    a, b, c = (1, 2, 3) if is_face else (2, 3, None)
    points[:, a, 0] = 0.0
    points[:, b, 0] = np.where(kind >= 1, 0.0, far)
    u = np.where(kind >= 1, dyadic(rng, 0.25, 0.5, (n,)), 0.0)
    meet = points[:, a] + u[:, None] * (points[:, b] - points[:, a])
    if c is not None:
        points[:, c, 0] = np.where(kind == 2, 0.0, far)
        v = np.where(kind == 2, dyadic(rng, 0.0, 0.5, (n,)), 0.0)
        meet = meet + v[:, None] * (points[:, c] - points[:, a])
    first = _first(is_face)
    points[:, first] += (meet - points[:, 0])[:, None]
    return points


def facing(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Corners and boundaries that meet: point on point, point on edge, point in face, edge on edge."""
    points, toi = _facing(rng, n, is_face), _times(rng, n)
    return Family(*_passing(rng, points, _velocity(rng, n, 0), toi, is_face), toi)


def flat(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """The same in one plane throughout, for a quarter on one line."""
    points, toi, velocity = _facing(rng, n, is_face), _times(rng, n), _velocity(rng, n, 0)
    for x in (points, velocity):
        x[..., 2] = 0.0
        x[::4, ..., 1] = 0.0
    return Family(*_passing(rng, points, velocity, toi, is_face), toi)


def collapsed(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """The same with edges of no length and faces of no area."""
    points, toi = _facing(rng, n, is_face), _times(rng, n)
    kind = np.arange(n) % 3
    if is_face:
        points[kind == 0, 3] = points[kind == 0, 1]
        points[kind == 1, 2:] = points[kind == 1, 1:2]
        points[kind == 2, 3] = 0.5 * (points[kind == 2, 1] + points[kind == 2, 2])
        points[:, 0] = points[:, 1]
    else:
        points[kind != 1, 1] = points[kind != 1, 0]
        points[kind != 0, 2:] = points[kind != 0, :1]
    return Family(*_passing(rng, points, _velocity(rng, n, 0), toi, is_face), toi)


def kept_apart(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """The same at a minimum separation, which is reached, or just not reached."""
    points, toi, velocity = _facing(rng, n, is_face), _times(rng, n), _velocity(rng, n, 0)
    separation = 2.0 ** -float(rng.integers(2, 8))
    short_of = np.where(np.arange(n) % 3 == 0, 2.0 ** -rng.integers(6, 10 if bits <= 24 else 30, n), 0.0)
    toi = np.where(short_of > 0, 1.0, toi)
    points[:, _first(is_face), 0] -= (separation + short_of)[:, None]
    toi_known = np.where(short_of > 0, NEVER, toi)
    return Family(*_passing(rng, points, velocity, toi, is_face, slant=False), toi_known, separation)


def shared(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """A common vertex, or a common edge, throughout; for a third only at the start."""
    start, end = (dyadic(rng, -2, 2, (n, 4, 3), 10) for _ in range(2))
    two = np.arange(n) % 2 == 0
    for x, rows in ((start, np.ones(n, dtype=bool)), (end, np.arange(n) % 3 > 0)):
        x[rows, 0] = x[rows, 2]
        if not is_face:
            x[rows & two, 1] = x[rows & two, 3]
    start, end = _disguised(rng, start, end, is_face, False)
    return Family(start, end, np.zeros(n))


def one_unit(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Passes a boundary one unit in the last place outside of it, on it, or one inside."""
    off = rng.integers(-1, 2, n)
    x = np.where(off < 0, 1.0 - 2.0**-bits, 1.0 + off * 2.0 ** (1 - bits))
    y, toi, one = dyadic(rng, -1, 1, (n,)), _times(rng, n), np.ones(n)
    zero = np.zeros(n)
    wall = [(one, -2 * one, zero), (one, 2 * one, zero)]
    if is_face:
        columns = [(x, y, zero), *wall, (dyadic(rng, 1.5, 4, (n,)), zero, zero)]
    else:
        columns = [(x, y, zero), (-dyadic(rng, 0.5, 4, (n,)), dyadic(rng, -1, 1, (n,)), zero), *wall]
    points = np.array(columns).transpose(2, 0, 1)
    velocity = np.stack([zero, zero, dyadic(rng, 0.0625, 3, (n,))], axis=1)
    start, end = _passing(rng, points, velocity, toi, is_face, slant=False)
    return Family(start, end, np.where(off < 0, NEVER, toi))


def needle(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Faces 1e6 to 1e12 times as long as wide, and edges as close to parallel, hit or just missed."""
    width = 2.0 ** -rng.integers(20, 41, n)
    hit, zero, two = np.arange(n) % 2 == 0, np.zeros(n), np.full(n, 2.0)
    if is_face:
        y = np.where(hit, 0.25 * width, -0.25 * width)
        columns = [(zero, y, zero), (-two, zero, zero), (two, zero, zero), (zero, width, zero)]
    else:  # the edges' lines meet at x = 0
        end = np.where(hit, 1.0, -0.25)
        columns = [(-two, -2 * width, zero), (end, end * width, zero), (-two, 2 * width, zero), (two, -2 * width, zero)]
    points, toi = np.array(columns).transpose(2, 0, 1), _times(rng, n)
    velocity = np.stack([zero, zero, dyadic(rng, 0.0625, 3, (n,))], axis=1)
    start, end = _passing(rng, points, velocity, toi, is_face, slant=False)
    return Family(start, end, np.where(hit, toi, NEVER))


def _unknown(start: np.ndarray, end: np.ndarray) -> Family:
    return Family(start, end, np.full(len(start), np.nan))


def _of(generator: adversarial.Generator) -> Maker:
    def make(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
        queries = generator(rng, n, is_face)
        return _unknown(queries.points_t0, queries.points_t1)

    return make


def random_needles(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Random, squeezed in a rotating direction; some are aimed at each other."""
    start, end = rng.normal(size=(2, n, 4, 3))
    squeeze = 10.0 ** -rng.uniform(2, 4, (n, 1))
    for x in (start, end):
        second = slice(1, 4) if is_face else slice(2, 4)
        axis = rng.normal(size=(n, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        middle = x[:, second].mean(axis=1, keepdims=True)
        arm = x[:, second] - middle
        x[:, second] = (
            middle + arm - (1 - squeeze[:, None]) * axis[:, None] * (arm * axis[:, None]).sum(axis=2, keepdims=True)
        )
        aimed = np.arange(n) % 2 == 0
        x[aimed, 0] += (middle[:, 0] - x[:, 0])[aimed] + 2 * squeeze[aimed] * rng.normal(size=(n, 3))[aimed]
    return _unknown(start, end)


def random_fast(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Unit size, moving up to a million times that, aimed at one another."""
    points = rng.normal(size=(n, 4, 3))
    velocity = rng.normal(size=(n, 1, 3)) * 10.0 ** rng.uniform(1, 6 if bits > 24 else 3, (n, 1, 1))
    velocity = velocity * np.array([1.0] * (1 if is_face else 2) + [0.0] * (3 if is_face else 2))[:, None]
    t = rng.random((n, 1, 1))
    return _unknown(points - t * velocity, points + (1 - t) * velocity)


def far_away(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Unit size, but 1e8 (in few bits: a thousand) from the origin."""
    start, end = rng.normal(size=(2, n, 4, 3)) + (1e8 if bits > 24 else 1e3)
    return _unknown(start, end)


def near_boundary(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Aimed at a boundary of the second primitive and off by 1e-10 .. 1e-2 of its size, either way."""
    points, velocity = rng.normal(size=(2, n, 4, 3))
    w, t = rng.random((n, 1)), rng.random((n, 1, 1))
    off = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-10 if bits > 24 else -5, -2, (n, 1))
    boundary = (1 - w) * points[:, 2] + w * points[:, 3] + off
    points[:, _first(is_face)] += (boundary - points[:, 0])[:, None]
    return _unknown(points - t * velocity, points + (1 - t) * velocity)


def passing(rng: np.random.Generator, n: int, is_face: bool, bits: int) -> Family:
    """Pass one another at a separation and 1.1 to 10 tolerances more, or a hundredth of one less, all four points in
    motion: the distance has a minimum there, or another extremum, at a random time. Half of them are nearest at an end
    of the first edge, or at a side of the face.
    """
    points, velocity = rng.normal(size=(2, n, 4, 3))
    separation = 10.0 ** -rng.uniform(0.5, 3)
    tolerance = separation * 10.0 ** -rng.uniform(3, 8 if bits > 24 else 3.5)
    clearance = separation + tolerance * rng.choice([-0.01, 1.1, 2.0, 10.0], (n, 1))
    t, u, v = rng.random((n, 1, 1)), *rng.uniform(0.02, 0.98, (2, n, 1))
    at_end = (np.arange(n) % 2 == 0)[:, None]
    u = np.where(at_end, 0.0, u)
    one, zero = np.ones((n, 1)), np.zeros((n, 1))
    weights = np.stack([one, 1 - v, zero, v] if is_face else [1 - u, u, 1 - v, v], axis=1)
    if is_face:
        inside = np.stack([one, 1 - u - v * (1 - u), u, v * (1 - u)], axis=1)
        weights = np.where(at_end[:, None], weights, inside)
    first = slice(0, 1) if is_face else slice(0, 2)
    second = slice(1, 4) if is_face else slice(2, 4)
    edge = points[:, 3] - points[:, 1 if is_face else 2]
    other = points[:, 2] - points[:, 1] if is_face else points[:, 0] - points[:, 1]
    # From the first primitive to the second: the common normal, or at an end a normal of the second one's edge on which
    # the rest of both lies further away.
    normal = np.cross(other, edge)
    aside = np.cross(edge, np.cross(rng.normal(size=(n, 3)), edge))
    aside *= np.where((aside * other).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    normal = np.where(at_end, aside, normal)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def gap(x: np.ndarray) -> np.ndarray:
        return (weights[:, second] * x[:, second]).sum(axis=1) - (weights[:, first] * x[:, first]).sum(axis=1)

    points[:, second] += (clearance * normal - gap(points))[:, None]
    velocity[:, second] -= (normal * (gap(velocity) * normal).sum(axis=1, keepdims=True))[:, None]
    unknown = _unknown(points - t * velocity, points + (1 - t) * velocity)
    return Family(unknown.points_t0, unknown.points_t1, unknown.toi, separation, tolerance)


KNOWN: tuple[Maker, ...] = (
    crossing,
    fast,
    short,
    still,
    graze,
    facing,
    flat,
    collapsed,
    kept_apart,
    shared,
    one_unit,
    needle,
)
UNKNOWN: dict[str, Maker] = {
    "random": _of(adversarial.random),
    "one point moves": _of(adversarial.one_point),
    "half turn": _of(adversarial.half_turn),
    "random needles": random_needles,
    "random fast": random_fast,
    "far away": far_away,
    "near boundary": near_boundary,
    "passing": passing,
}
# Degenerate queries, mostly undecided by the batch oracle, for small numbers.
EXACT: dict[str, Maker] = {
    "grid, coplanar": _of(adversarial.coplanar),
    "grid, parallel": _of(adversarial.parallel),
    "grid, degenerate": _of(adversarial.degenerate),
}
