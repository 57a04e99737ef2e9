"""The batch oracle against the exact one and the outward-rounded one; and that it decides most queries."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from support.cases import few_and_many

from . import adversarial, arcs, batch, distance, families, linear, rigid, separation
from .batch_paths import ArcPaths, StraightPaths, Turning, Window
from .linear import Hit
from .search import CLOSE, NO, YES, Decisions

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])


def exact(start: np.ndarray, end: np.ndarray, is_face: bool, kept: float) -> list[Hit | None]:
    if kept:
        return separation.within_many(start, end, kept, is_face)
    return (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)


def assert_agree(found: Decisions, truth: list[Hit | None]) -> None:
    for k, hit in enumerate(truth):
        if found.status[k] != CLOSE:
            assert (found.status[k] == YES) == (hit is not None), k
        if hit is None:
            assert np.isinf(found.toi_upper[k])
        else:
            assert Fraction(found.toi_lower[k]) <= hit.toi_upper, k
            assert np.isinf(found.toi_upper[k]) or Fraction(found.toi_upper[k]) >= hit.toi_lower, k


@KINDS
@pytest.mark.parametrize("kept", [0.0, 0.05])
@pytest.mark.parametrize("generator", adversarial.GENERATORS, ids=lambda g: g.__name__)
def test_against_the_exact_oracle(generator: adversarial.Generator, is_face: bool, kept: float) -> None:
    q = generator(np.random.default_rng(1), 40 if kept == 0.0 else 12, is_face)
    found = batch.first_within(StraightPaths(q.points_t0, q.points_t1, is_face), kept)
    assert_agree(found, exact(q.points_t0, q.points_t1, is_face, kept))


@KINDS
@pytest.mark.parametrize("bits", [53, 24])
@pytest.mark.parametrize("maker", families.KNOWN, ids=lambda m: m.__name__)
def test_families_are_what_they_claim(maker: families.Maker, is_face: bool, bits: int) -> None:
    family = maker(np.random.default_rng(2), 36, is_face, bits)
    for k, hit in enumerate(exact(family.points_t0, family.points_t1, is_face, family.separation)):
        assert (hit is None) == np.isinf(family.toi[k])
        assert hit is None or hit.toi_lower <= Fraction(family.toi[k]) <= hit.toi_upper
    if bits == 24:
        for x in (family.points_t0, family.points_t1):
            assert np.array_equal(x.astype(np.float32), x)
    assert_agree(
        batch.first_within(StraightPaths(family.points_t0, family.points_t1, is_face), family.separation),
        [None if np.isinf(t) else Hit(Fraction(t), Fraction(t)) for t in family.toi],
    )


@KINDS
@pytest.mark.parametrize("name", families.UNKNOWN)
def test_what_is_not_degenerate_is_decided_and_timed(name: str, is_face: bool) -> None:
    family = families.UNKNOWN[name](np.random.default_rng(3), 2000, is_face, 53)
    for kept in (0.0, family.separation or 0.01):
        found = batch.first_within(StraightPaths(family.points_t0, family.points_t1, is_face), kept)
        yes = found.status == YES
        assert (found.status == CLOSE).mean() < (0.02 if name in ("random needles", "near boundary") else 1e-3)
        assert (found.status == NO).any() and yes.sum() > 5
        assert np.quantile(found.toi_upper[yes] - found.toi_lower[yes], 0.95) < 1e-9


@KINDS
def test_decide_straight_leaves_nothing_open(is_face: bool) -> None:
    for generator in (adversarial.coplanar, adversarial.degenerate, adversarial.graze, adversarial.near_miss):
        q = generator(np.random.default_rng(4), 30, is_face)
        for kept in (0.0, 2.0**-20):
            found, asked = batch.decide_straight(q.points_t0, q.points_t1, is_face, kept)
            truth = exact(q.points_t0, q.points_t1, is_face, kept)
            assert (found.status != CLOSE).all() and [s == YES for s in found.status] == [h is not None for h in truth]
            assert asked.any() or kept > 0
            assert_agree(found, truth)


@KINDS
def test_directions_whose_squares_vanish_prove_nothing(is_face: bool) -> None:
    start, end = np.random.default_rng(13).normal(size=(2, 50, 4, 3))
    zero = np.zeros(50)
    window = StraightPaths(start, end, is_face).over(np.arange(50), zero, zero)
    for size in (0.0, 1e-300, 1e-170, 1e300):
        direction = size * np.random.default_rng(14).normal(size=(3, 50))
        assert (batch.apart_by(window, [(direction, direction)], is_face) == -np.inf).all()


@KINDS
def test_only_until(is_face: bool) -> None:
    q = adversarial.contact_at(np.random.default_rng(5), 200, is_face)
    paths = StraightPaths(q.points_t0, q.points_t1, is_face)
    assert (batch.first_within(paths, until=q.toi * (1 - 1e-9)).status == NO).all()
    assert (batch.first_within(paths, until=q.toi).status != NO).all()
    assert (batch.first_within(paths, until=0.0).status == NO).all()


@KINDS
def test_distances_are_upper_bounds(is_face: bool) -> None:
    q = adversarial.everything(np.random.default_rng(6), 8, is_face)
    t = np.random.default_rng(7).random(len(q.toi))
    found = batch.distance_at(StraightPaths(q.points_t0, q.points_t1, is_face), t)
    for k, value in enumerate(found):
        square = distance.squared_distance_exact(q.points_t0[k], q.points_t1[k], t[k], is_face)
        size = max(np.ptp(q.points_t0[k], axis=0).max(), np.ptp(q.points_t1[k], axis=0).max())
        assert Fraction(value) ** 2 >= square
        assert value <= float(square) ** 0.5 * (1 + 1e-9) + 1e-13 * size


def arc_queries(seed: int, plan: arcs.Plan, is_face: bool, n: int) -> tuple[np.ndarray, Turning, Turning]:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 4, 3))
    return (points, *arcs.motions(rng, plan, points, is_face, 1.0, clearance=0.06))


def intervals(points: np.ndarray, first: Turning, second: Turning, is_face: bool, kept: float) -> Decisions:
    bodies = [
        rigid.BodyMotion.from_rotation(b.position_t0, b.orientation_t0, b.position_t1, b.rotation)
        for b in (first, second)
    ]
    return (rigid.vertex_face if is_face else rigid.edge_edge)(points, *bodies, kept)


@KINDS
@pytest.mark.parametrize("kept", [0.0, 0.05])
@pytest.mark.parametrize("name", arcs.PLANS)
@few_and_many("count", 8, 30)
def test_arcs_against_the_intervals(name: str, is_face: bool, kept: float, count: int) -> None:
    points, first, second = arc_queries(8, arcs.PLANS[name], is_face, count)
    found = batch.first_within(ArcPaths(points, first, second, is_face), kept)
    truth = intervals(points, first, second, is_face, kept)
    both = (found.status != CLOSE) & (truth.status != CLOSE)
    assert (found.status == truth.status)[both].all()
    yes = both & (truth.status == YES)
    assert (found.toi_lower <= truth.toi_upper)[yes].all() and (truth.toi_lower <= found.toi_upper)[yes].all()
    assert both.mean() > 0.8 and (yes.any() or not arcs.PLANS[name].aimed)


@KINDS
@pytest.mark.parametrize("name", ["meeting", "many turns", "small turns", "fast"])
def test_arcs_lie_where_they_should(name: str, is_face: bool) -> None:
    """The enclosure of every path contains the position computed from the definition of the matrix exponential."""
    points, first, second = arc_queries(9, arcs.PLANS[name], is_face, 12)
    paths, rng = ArcPaths(points, first, second, is_face), np.random.default_rng(10)
    a = rng.random(12) * 0.9
    b = a + 0.1 * rng.random(12)
    window, count = paths.over(np.arange(12), a, b), 1 if is_face else 2
    s = rng.random(12)
    weights = np.array([(1 - s) ** 2, 2 * s * (1 - s), s * s])
    curve = (weights[:, None, None] * window.control).sum(axis=0)
    for k in range(12):
        t = float(a[k] + s[k] * (b[k] - a[k]))
        for j in range(4):
            body = first if j < count else second
            pose = (body.position_t0[k], body.orientation_t0[k], body.position_t1[k], body.rotation[k])
            there = rigid.position(points[k, j], *pose, t)
            centre = [
                mpmath.mpf(p) + mpmath.mpf(t) * (mpmath.mpf(q) - mpmath.mpf(p))
                for p, q in zip(first.position_t0[k].tolist(), first.position_t1[k].tolist(), strict=True)
            ]
            off = np.array([float(x - c) for x, c in zip(there, centre, strict=True)]) * paths.scale[k] - curve[j, :, k]
            assert np.linalg.norm(off) <= window.rest[0 if j < count else 1, k] + window.rounding[k]


@KINDS
def test_the_rest_matters(is_face: bool) -> None:
    """Without the remainder false claims are made: the tests above can fail."""
    points, first, second = arc_queries(11, arcs.PLANS["many turns"], is_face, 1000)
    paths = ArcPaths(points, first, second, is_face)
    over = paths.over

    def careless(query: np.ndarray, a: np.ndarray, b: np.ndarray) -> Window:
        window = over(query, a, b)
        return Window(window.control, 0 * window.rest, window.rounding)

    truth = batch.first_within(paths)
    paths.over = careless  # type: ignore[method-assign]
    wrong = batch.first_within(paths)
    assert ((truth.status == YES) & (wrong.toi_lower > truth.toi_upper)).any()


def test_sine_and_cosine_are_as_good_as_assumed() -> None:
    angle = np.concatenate([np.random.default_rng(12).uniform(-40, 40, 3000), np.arange(-60, 60) * (np.pi / 4)])
    for function, true in ((np.sin, mpmath.sin), (np.cos, mpmath.cos)):
        for x, y in zip(angle.tolist(), function(angle).tolist(), strict=True):
            assert abs(mpmath.mpf(y) - true(mpmath.mpf(x))) <= 4 * np.spacing(max(abs(y), 2.0**-60))
