"""The oracle of rigid arcs: intervals against mpmath, decisions against analytic cases, sampling, the exact oracle."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from support.cases import few_and_many

from . import distance, linear, rigid, search
from .interval import Interval, cross, dot, norm, sinc_cosc

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
ORIGIN = np.zeros(3)


def encloses(interval: Interval, values: list[mpmath.mpf]) -> bool:
    pairs = zip(interval.lo.ravel().tolist(), interval.hi.ravel().tolist(), values, strict=True)
    return all(lo <= value <= hi for lo, hi, value in pairs)


def test_intervals_enclose() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 200)) * 10.0 ** rng.integers(-8, 8, (2, 200))
    exact_a, exact_b = [mpmath.mpf(x) for x in a], [mpmath.mpf(x) for x in b]
    with mpmath.workdps(60):
        pairs = list(zip(exact_a, exact_b, strict=True))
        x, y = Interval(a), Interval(b)
        assert encloses(x + y, [p + q for p, q in pairs])
        assert encloses(x - y, [p - q for p, q in pairs])
        assert encloses(x * y, [p * q for p, q in pairs])
        assert encloses(x.square(), [p * p for p, _ in pairs])
        assert encloses(x / Interval(np.abs(b)), [p / abs(q) for p, q in pairs])
        assert encloses(Interval(np.abs(a)).sqrt(), [mpmath.sqrt(abs(p)) for p in exact_a])
        wide = Interval(-np.abs(a), np.abs(a)) * y
        assert encloses(wide, [p * q for p, q in pairs]) and encloses(wide, [-p * q for p, q in pairs])
        angle = np.concatenate([rng.uniform(0, 20, 200), rng.uniform(0, 1e-7, 50)])
        sinc, cosc = sinc_cosc(Interval(angle))
        precise = [mpmath.mpf(t) for t in angle]
        assert encloses(sinc, [mpmath.sin(t) / t for t in precise])
        assert encloses(cosc, [(1 - mpmath.cos(t)) / t**2 for t in precise])
        assert (sinc.hi - sinc.lo).max() < 1e-13
    u, w = rng.normal(size=(2, 50, 3))
    assert np.allclose(dot(Interval(u), w).lo, (u * w).sum(axis=1))
    assert np.allclose(cross(Interval(u), Interval(w)).lo, np.cross(u, w))
    assert np.allclose(norm(Interval(u)).hi, np.linalg.norm(u, axis=1))


def test_rotation_between_orientations_is_the_shorter_way() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        q0, w = rng.normal(size=4), rng.normal(size=3)
        w *= rng.uniform(0, 3.1) / np.linalg.norm(w)
        half = np.linalg.norm(w) / 2
        s, u = np.cos(half), np.sin(half) * w / np.linalg.norm(w)
        q1 = np.concatenate([[s * q0[0] - u @ q0[1:]], s * q0[1:] + q0[0] * u + np.cross(u, q0[1:])])
        for sign in (1.0, -1.0):  # q and -q are one orientation
            found = rigid.rotation_between(q0, sign * q1)
            assert np.allclose(found.lo, w, atol=1e-12)
            assert (found.lo <= found.hi).all() and (found.hi - found.lo).max() < 1e-14
    assert (rigid.rotation_between(IDENTITY, -IDENTITY).hi == 0).all()
    half_turn = rigid.rotation_between(IDENTITY, np.array([0.0, 0.0, -2.0, 0.0]))
    assert half_turn.lo[1] <= -np.pi <= half_turn.hi[1]


def arc(position: object, rotation: object, end: object | None = None) -> rigid.BodyMotion:
    return rigid.BodyMotion.from_rotation(position, IDENTITY, position if end is None else end, rotation)


def test_paths_enclose_the_matrix_exponential_and_its_derivative() -> None:
    rng = np.random.default_rng(2)
    points, q = rng.normal(size=(1, 4, 3)), rng.normal(size=(2, 4))
    ends, spin = rng.normal(size=(2, 2, 3)) * 100, rng.normal(size=(2, 3)) * 3
    bodies = [rigid.BodyMotion.from_rotation(ends[0, k], q[k], ends[1, k], spin[k]) for k in (0, 1)]
    for is_face in (True, False):
        paths = rigid.RigidPaths(points, bodies[0], bodies[1], is_face)
        for t in (0.0, 0.375, 1.0):
            x, v, _ = paths.derivatives(np.array([0]), np.array([t]))
            origin = rigid.position(ORIGIN, ends[0, 0], q[0], ends[1, 0], spin[0], t)
            for k in range(4):
                body = 0 if k == 0 or (k == 1 and not is_face) else 1

                def place(time: float, k: int = k, body: int = body) -> list[mpmath.mpf]:
                    return rigid.position(points[0, k], ends[0, body], q[body], ends[1, body], spin[body], time)

                with mpmath.workdps(40):
                    assert encloses(x[0, k], [p - o for p, o in zip(place(t), origin, strict=True)])
                drift = ends[1, 0] - ends[0, 0]
                slope = [float(b - a) / 2e-6 for a, b in zip(place(t - 1e-6), place(t + 1e-6), strict=True)]
                assert np.allclose(v.lo[0, k], np.array(slope) - drift, atol=1e-6)
            assert (x.hi - x.lo).max() < 1e-12


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_swinging_vertex_meets_a_wall_at_the_analytic_time(far: float) -> None:
    # A vertex at (1, 0, 0) turns by 1 about z and meets the plane y = 1/2 when sin t = 1/2.
    origin = np.array([far, 0.0, 0.0])
    points = np.array([[[1.0, 0, 0], [0, 0.5, -1], [2, 0.5, -1], [1, 0.5, 2]]])
    found = rigid.vertex_face(points, arc(origin, [0.0, 0, 1]), arc(origin, ORIGIN))
    assert found.name(0) == "yes"
    assert found.toi_lower[0] <= np.pi / 6 <= found.toi_upper[0]
    assert found.toi_upper[0] - found.toi_lower[0] <= 1e-9
    # The straight path between the same ends touches it elsewhere: the arc is tested.
    end = np.array([[[np.cos(1), np.sin(1), 0], *points[0, 1:]]])
    straight = linear.vertex_face(points[0], end[0])
    assert straight is not None and abs(float(straight.toi_lower) - np.pi / 6) > 0.05


@pytest.mark.parametrize(
    ("gap", "separation", "answer"),
    [
        (0.01, 0.0, "no"),
        (1e-9, 0.0, "no"),
        (0.01, 0.009, "no"),
        (0.01, 0.011, "yes"),
        (-0.01, 0.0, "yes"),
        (0.0, 0.0, "?"),
    ],
)
def test_arc_that_only_just_reaches(gap: float, separation: float, answer: str) -> None:
    # The vertex's circle of radius 1 has its highest point at a quarter turn, below (gap > 0) a wall at y = 1 + gap;
    # the straight path between the ends of the half turn would not come near.
    points = np.array([[[1.0, 0, 0], [-3, 1 + gap, -3], [3, 1 + gap, -3], [0, 1 + gap, 3]]])
    found = rigid.vertex_face(points, arc(ORIGIN, [0.0, 0, np.pi]), arc(ORIGIN, ORIGIN), separation)
    if answer == "?":
        assert found.name(0) == "too close to call"
        assert found.toi_lower[0] == pytest.approx(0.5, abs=1e-3) and np.isinf(found.toi_upper[0])
    else:
        assert found.name(0) == answer
    if answer == "yes":
        expected = np.arcsin(1 + gap - separation) / np.pi
        assert found.toi_lower[0] <= expected + 1e-12 and expected <= found.toi_upper[0] + 1e-12


def test_more_than_one_turn() -> None:
    # Two and a half turns about z while rising from z = -1 by 1: at z = -0.5 the arm points to -x for the second time.
    points = np.array([[[1.0, 0, 0], [-1, -1, -2], [-1, 1, -2], [-1, 0, -0.45]]])
    body = arc([0.0, 0, -1], [0.0, 0, 5 * np.pi], [0.0, 0, 0])
    still = arc(ORIGIN, ORIGIN)
    found = rigid.vertex_face(points + [[[0.0, 0, 0], [1e-3, 0, 0], [1e-3, 0, 0], [1e-3, 0, 0]]], body, still)
    assert found.name(0) == "yes"
    assert found.toi_lower[0] == pytest.approx(0.2, abs=0.01)


@KINDS
def test_without_rotation_it_agrees_with_the_exact_oracle(is_face: bool) -> None:
    rng = np.random.default_rng(3)
    n = 300
    points, ends = rng.normal(size=(n, 4, 3)), rng.normal(size=(2, 2, n, 3))
    bodies = [
        rigid.BodyMotion.from_rotation(ends[0, k], np.tile(IDENTITY, (n, 1)), ends[1, k], np.zeros((n, 3)))
        for k in (0, 1)
    ]
    found = (rigid.vertex_face if is_face else rigid.edge_edge)(points, *bodies)
    offset = np.stack([ends[:, 0 if k == 0 or (k == 1 and not is_face) else 1] for k in range(4)], axis=2)
    exact = linear._many(points + offset[0], points + offset[1], is_face, linear.WIDTH)
    assert sum(hit is not None for hit in exact) > 10
    for k, hit in enumerate(exact):
        assert found.name(k) == ("no" if hit is None else "yes")
        if hit is not None:
            assert found.toi_lower[k] - 1e-12 <= float(hit.toi_lower) <= found.toi_upper[k] + 1e-12


def floats(points: np.ndarray, p0: np.ndarray, q: np.ndarray, p1: np.ndarray, w: np.ndarray, t: float) -> np.ndarray:
    s, u = q[:, :1], q[:, 1:]
    r = points + 2 * (s * np.cross(u, points) + np.cross(u, np.cross(u, points)))
    angle = np.linalg.norm(w, axis=1, keepdims=True)
    k = w / angle
    along = k * (k * r).sum(axis=1, keepdims=True)
    return p0 + t * (p1 - p0) + along + np.cos(angle * t) * (r - along) + np.sin(angle * t) * np.cross(k, r)


@KINDS
@pytest.mark.parametrize("separation", [0.0, 0.05])
@few_and_many("n", 120, 240)
def test_against_dense_sampling(is_face: bool, separation: float, n: int) -> None:
    rng = np.random.default_rng(4)
    samples = 401
    points, ends = rng.normal(size=(n, 4, 3)), rng.normal(size=(2, 2, n, 3))
    q, spin = rng.normal(size=(2, n, 4)), rng.normal(size=(2, n, 3)) * np.repeat([0.1, 0.5, 1, 3], n // 4)[:, None]
    q /= np.linalg.norm(q, axis=2, keepdims=True)
    bodies = [rigid.BodyMotion.from_rotation(ends[0, k], q[k], ends[1, k], spin[k]) for k in (0, 1)]
    found = (rigid.vertex_face if is_face else rigid.edge_edge)(points, *bodies, separation)
    owner = [0 if k == 0 or (k == 1 and not is_face) else 1 for k in range(4)]
    times = np.linspace(0, 1, samples)
    sampled = np.empty((samples, n))
    for s, t in enumerate(times):
        x = [floats(points[:, k], ends[0, b], q[b], ends[1, b], spin[b], t) for k, b in enumerate(owner)]
        sampled[s] = distance.min_distance_at(np.stack(x, axis=1), np.stack(x, axis=1), 0.0, is_face)
    least = sampled.min(axis=0)
    assert (found.status != search.CLOSE).all()
    no, yes = found.status == search.NO, found.status == search.YES
    assert yes.sum() > 5
    assert (least[no] > separation - 1e-12).all()
    assert (least[yes] < separation + 0.15).all()  # speeds are below some 30, steps 1 / 400
    lower, upper, at = rigid.closest_approach(points, *bodies, is_face)
    assert (upper - lower < 1e-9).all() and (lower <= least + 1e-12).all()
    assert (lower[no] > separation).all() if separation else (upper[yes] < 1e-6).all()
    assert (lower[yes] <= separation).all()
    for k in np.flatnonzero(yes):
        assert not (sampled[times < found.toi_lower[k] - 1e-9, k] <= separation - 1e-12).any()
        assert found.toi_upper[k] - found.toi_lower[k] <= 1e-8
    assert ((at >= 0) & (at <= 1)).all()


@KINDS
def test_bounds_over_long_intervals_hold_for_fast_turns(is_face: bool) -> None:
    """|w| h is about 1: no term is small."""
    rng = np.random.default_rng(5)
    n, samples = 300, 201
    points, ends = rng.normal(size=(n, 4, 3)), rng.normal(size=(2, 2, n, 3)) * 4
    q, spin = rng.normal(size=(2, n, 4)), rng.normal(size=(2, n, 3)) * 3
    q /= np.linalg.norm(q, axis=2, keepdims=True)
    bodies = [rigid.BodyMotion.from_rotation(ends[0, k], q[k], ends[1, k], spin[k]) for k in (0, 1)]
    paths = rigid.RigidPaths(points, bodies[0], bodies[1], is_face)
    middle, half = rng.uniform(0.3, 0.7, n), rng.uniform(0.1, 0.3, n)
    taylor = paths.derivatives(np.arange(n), middle)
    bound = search.lower_bound(taylor, paths.jerk, half, is_face)
    box = search.swept_box(taylor, paths.jerk, half)
    least = np.full(n, np.inf)
    for s in np.linspace(-1, 1, samples):
        x = paths.derivatives(np.arange(n), middle + s * half)[0]
        assert (box.lo <= x.hi).all() and (x.lo <= box.hi).all()
        least = np.minimum(least, search.upper_bound(x, is_face))
    assert (bound <= least).all()
    assert (bound > 0).sum() > 5


@KINDS
def test_the_remainder_is_needed_and_is_tight(is_face: bool) -> None:
    # An arm of length 1 points along x at t = 1/2 while its base moves back along y as fast as it swings: to second
    # order it is at rest, 0.2 below a wall, but earlier it was higher by x - sin x with x = 3 s.
    w, h = 3.0, 0.3
    tip = [np.cos(-w / 2), np.sin(-w / 2)]
    first = [[*tip, 0.0]] if is_face else [[*tip, -1.0], [*tip, 1.0]]
    wall = [[-9, 0, -9], [9, 0, -9], [0, 0, 9]] if is_face else [[-9, 0, 0], [9, 0, 0]]
    points = np.array([[*first, *(np.array(wall) + [0, 0.2 - w / 2, 0])]])
    body = arc(ORIGIN, [0.0, 0, w], [0.0, -w, 0])
    paths = rigid.RigidPaths(points, body, arc(ORIGIN, ORIGIN), is_face)
    taylor = paths.derivatives(np.array([0]), np.array([0.5]))
    least = 0.2 - (w * h - np.sin(w * h))
    bound = search.lower_bound(taylor, paths.jerk, np.array([h]), is_face)[0]
    assert least - 0.01 < bound <= least
    assert search.lower_bound(taylor, 0 * paths.jerk, np.array([h]), is_face)[0] > least
    method = rigid.vertex_face if is_face else rigid.edge_edge
    assert method(points, body, arc(ORIGIN, ORIGIN), 0.0).name(0) == "yes"  # at t = 0 it was above
