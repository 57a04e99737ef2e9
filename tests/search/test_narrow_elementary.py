"""The elementary tests against exact rational arithmetic: 0 missed, never late, nothing invented beyond tolerance."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import distance
from oracle.adversarial import GENERATORS, Generator
from oracle.constructed import FREE, TOUCH
from strategies import degenerate_features, feature_motions
from support.cases import few_and_many
from support.elementary import check, rounding, solve, truth

import pgccd

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])
ALL = pytest.mark.parametrize("generator", GENERATORS, ids=lambda g: g.__name__)
# Allowed unresolved fraction where features touch over whole intervals or graze.
HARD = {"graze": 0.4, "coplanar": 0.4, "near_miss": 0.6}


def run_at_once(generator: Generator, is_face: bool, count: int, seed: int, device: torch.device) -> None:
    queries = generator(np.random.default_rng(seed), count, is_face)
    points = queries.points_t0, queries.points_t1
    unresolved = HARD.get(generator.__name__, 0.03)
    for tolerance in (1e-6, 1e-12):
        contacts = check(*points, is_face, tolerance=tolerance, most_unresolved=unresolved, device=device)
        assert contacts >= (queries.truth == TOUCH).sum()
    # Queries that miss by far more than the tolerance must not be reported.
    status = solve(*points, is_face, tolerance=1e-20, device=device)[0]
    size = np.abs(np.concatenate(points, axis=1)).max(axis=(1, 2))
    clear = (queries.truth == FREE) & (generator.__name__ == "short_of_end") & (size < 2.0**40)
    assert (status[clear] == pgccd.Status.FREE).all()


def run_separated(generator: Generator, is_face: bool, count: int, seed: int, device: torch.device) -> None:
    queries = generator(np.random.default_rng(seed), count, is_face)
    size = np.abs(queries.points_t0 - queries.points_t0[:, :1]).max(axis=(1, 2))
    # One separation per call: queries of similar size together, with separations from a billionth of it to that size.
    exponents = np.round(np.log2(np.maximum(size, 1e-300)))
    for exponent in np.unique(exponents)[:12]:
        group = exponents == exponent
        points = queries.points_t0[group], queries.points_t1[group]
        for relative in (2.0**-30, 0.0123, 0.25, 1.0):
            separation = float(relative * 2.0**exponent)
            check(*points, is_face, separation, 1e-6 * 2.0**exponent, most_unresolved=1.0, device=device)


def to_float32(queries: np.ndarray) -> np.ndarray:
    """The nearest float32 numbers, at a scale where their differences are representable too."""
    return queries.astype(np.float32).astype(np.float64)


@KINDS
@ALL
@few_and_many("count", 25, 60)
def test_float32(generator: Generator, is_face: bool, device: torch.device, count: int) -> None:
    queries = generator(np.random.default_rng(8), count, is_face)
    points = to_float32(queries.points_t0), to_float32(queries.points_t1)
    for separation in (0.0, 0.1):
        for tolerance in (1e-3, 1e-6):
            options = {"most_unresolved": 1.0, "device": device, "dtype": torch.float32}
            check(*points, is_face, separation, tolerance, **options)


@KINDS
def test_float32_settles_most_free_queries_itself(is_face: bool, device: torch.device) -> None:
    rng = np.random.default_rng(9)
    start, end = (torch.tensor(x, dtype=torch.float32, device=device) for x in rng.normal(size=(2, 4000, 4, 3)))
    test = pgccd.narrow.vertex_face if is_face else pgccd.narrow.edge_edge
    single, double = test(start, end), test(start.double(), end.double())
    assert torch.equal(single.status == pgccd.Status.FREE, double.status == pgccd.Status.FREE)
    assert single.toi.dtype == single.coordinates.dtype == torch.float32
    assert (single.toi.double() - double.toi)[double.toi < 1].abs().max() < 1e-6
    free = single.status == pgccd.Status.FREE
    assert (single.significant_bits[free] == 24).float().mean() > 0.95


@KINDS
def test_near_misses_are_free(is_face: bool, device: torch.device) -> None:
    """Touching and passing within an ulp are distinguished, for any tolerance."""
    queries = next(g for g in GENERATORS if g.__name__ == "near_miss")(np.random.default_rng(10), 400, is_face)
    hits = truth(queries.points_t0, queries.points_t1, is_face)
    touching = np.array([hit is not None for hit in hits])
    status = solve(queries.points_t0, queries.points_t1, is_face, tolerance=1e-3, device=device)[0]
    assert 40 < touching.sum() < 360
    assert (status[touching] != pgccd.Status.FREE).all()
    assert (status[~touching] == pgccd.Status.FREE).all()


@KINDS
@ALL
@pytest.mark.parametrize("times", [1, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("run", "count"), [(run_at_once, 60), (run_separated, 12)])
def test_adversarial(
    run: Callable[..., None], count: int, times: int, generator: Generator, is_face: bool, device: torch.device
) -> None:
    for seed in range(times):
        run(generator, is_face, count * times, 1000 * times + seed, device)


STRATEGIES = pytest.mark.parametrize("strategy", [feature_motions, degenerate_features], ids=lambda s: s.__name__)


def check_on_grid(strategy: Callable[[], st.SearchStrategy], is_face: bool, data: st.DataObject) -> None:
    start, end = data.draw(strategy())
    tolerance = data.draw(st.sampled_from([1e-6, 1e-12])) * max(np.abs(start).max(), np.abs(end).max(), 1e-30)
    check(start[None], end[None], is_face, 0.0, tolerance, most_unresolved=1.0)
    separation = data.draw(st.sampled_from([0.25, 1.0, 2.0**0.5])) * np.abs(start).max()
    check(start[None], end[None], is_face, separation, tolerance, most_unresolved=1.0)


@KINDS
@given(data=st.data())
@settings(max_examples=120)
@STRATEGIES
def test_grids(strategy: Callable[[], st.SearchStrategy], is_face: bool, data: st.DataObject) -> None:
    check_on_grid(strategy, is_face, data)


@pytest.mark.slow
@KINDS
@given(data=st.data())
@settings(max_examples=1000)
@STRATEGIES
def test_grids_at_length(strategy: Callable[[], st.SearchStrategy], is_face: bool, data: st.DataObject) -> None:
    check_on_grid(strategy, is_face, data)


@KINDS
@given(values=st.lists(st.floats(-1e18, 1e18), min_size=24, max_size=24))
@settings(max_examples=120)
def test_any_numbers(is_face: bool, values: list[float]) -> None:
    start, end = np.array(values).reshape(2, 1, 4, 3)
    check(start, end, is_face, most_unresolved=1.0)


@KINDS
@pytest.mark.parametrize("name", ["near_miss", "coplanar", "graze"])
def test_tight_tolerance_is_resolved(name: str, is_face: bool, device: torch.device) -> None:
    """Features that pass one another a thousand tolerances apart are free, and touches are reported as such."""
    generator = next(g for g in GENERATORS if g.__name__ == name)
    queries = generator(np.random.default_rng(1), 200, is_face)
    both = np.concatenate([queries.points_t0, queries.points_t1], axis=1)
    unit = 2.0 ** -np.ceil(np.log2(np.ptp(both, axis=1).max(axis=1)))[:, None, None]  # exact scaling to about unit size
    status = solve(queries.points_t0 * unit, queries.points_t1 * unit, is_face, tolerance=1e-12, device=device)[0]
    assert (status == pgccd.Status.UNRESOLVED).mean() <= 0.02


@KINDS
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e-100, 1e-40, 1e40, 1e100, 1e150, 1e300])
def test_extreme_sizes_are_never_missed(is_face: bool, size: float) -> None:
    rng = np.random.default_rng(5)
    for generator in GENERATORS:
        if generator.__name__ == "scales":
            continue
        queries = generator(rng, 12, is_face)
        points = [q * size / np.abs(queries.points_t0).max() / 8 for q in (queries.points_t0, queries.points_t1)]
        status, toi, _ = solve(*points, is_face, tolerance=min(1e-6 * size, 1e150))
        for k, hit in enumerate(truth(*points, is_face)):
            if hit is not None:
                assert status[k] != pgccd.Status.FREE, f"{generator.__name__} {k}: missed"
                assert Fraction(toi[k]) <= hit.toi_upper, f"{generator.__name__} {k}: late"


@KINDS
@ALL
@few_and_many("count", 25, 60)
def test_nonzero_toi(generator: Generator, is_face: bool, device: torch.device, count: int) -> None:
    queries = generator(np.random.default_rng(3), count, is_face)
    points = queries.points_t0, queries.points_t1
    for separation in (0.0, 1e-3):
        unresolved = HARD.get(generator.__name__, 0.1)
        check(*points, is_face, separation, 1e-2, nonzero_toi=True, most_unresolved=unresolved, device=device)
        status, toi, _ = solve(*points, is_face, separation, 1e-2, nonzero_toi=True, device=device)
        for k in range(len(toi)):
            square = distance.squared_distance_exact(points[0][k], points[1][k], 0.0, is_face)
            if square <= Fraction(separation) ** 2:
                assert toi[k] == 0.0, "starts in violation"
            elif square > (Fraction(separation) + rounding(points[0][k], points[1][k])) ** 2:
                assert toi[k] > 0.0, "starts apart, but toi is 0"


@KINDS
def test_toi_is_close_where_the_crossing_is_clear(is_face: bool, device: torch.device) -> None:
    queries = GENERATORS[1](np.random.default_rng(4), 200, is_face)  # straight through, at a known time
    points = queries.points_t0, queries.points_t1
    speed = np.abs((points[1] - points[1][:, -1:]) - (points[0] - points[0][:, -1:])).max(axis=(1, 2))
    tolerance = 1e-9 * float(speed.min())
    status, toi, _ = solve(*points, is_face, tolerance=tolerance, device=device)
    assert (status == pgccd.Status.TOUCH).all()
    assert (toi <= queries.toi).all() and (queries.toi - toi < 1e-8).all()


# Features that come within tolerance, pass each other, and touch later; points at t0, then at t1.
PASS_THEN_TOUCH_FACE = [
    [-0.20149979700081638, 0.7618783717914077, -0.8016520135004057],
    [-1.1909047686418877, 1.327108075348238, -1.397367176361778],
    [0.2781124844098308, -0.6928285237341198, 0.1912503297641015],
    [-0.09504656505432434, 0.37939647324377346, -0.5092153668236267],
    [0.23268950077946243, -1.0194572864999174, 0.4729258997674286],
    [-0.08901511661029138, 1.943574875759423, -0.5324292128452243],
    [0.6624103968839906, -0.8179481500851168, 0.40911838957508095],
    [-0.5145003062769486, 1.2638432893847296, -1.2188011306997353],
]
PASS_THEN_TOUCH_EDGES = [
    [-0.4855598331133351, -0.18882515955701362, -0.46890175842090887],
    [-0.5391390107096956, -0.02515511799181372, -0.8532790121208366],
    [-0.5007794888156187, 0.6013218337151341, -0.4634734344820867],
    [-1.714593239057844, -0.6713898615192755, -0.4314266268075145],
    [-1.8623058200262625, 1.3836359258091515, -0.5228895757674035],
    [0.2762231551807156, 0.9415155756172137, 0.9853221252069065],
    [0.36226830621654293, 0.4811614276321602, -0.07466916396112683],
    [-1.00935927230814, -0.0005580870636677782, -1.4153612134174638],
]


@pytest.mark.parametrize(
    ("points", "is_face", "tolerance"),
    [(PASS_THEN_TOUCH_FACE, True, 1e-6), (PASS_THEN_TOUCH_EDGES, False, 4.26684e-6)],
    ids=["vf", "ee"],
)
def test_a_near_miss_does_not_hide_a_later_touch(
    points: list[list[float]], is_face: bool, tolerance: float, device: torch.device
) -> None:
    start, end = np.array(points).reshape(2, 1, 4, 3)
    assert check(start, end, is_face, tolerance=tolerance, most_unresolved=0.0, device=device) == 1
    hit = truth(start, end, is_face)[0]
    status, toi, _ = solve(start, end, is_face, tolerance=tolerance, device=device)
    assert hit is not None and status[0] == pgccd.Status.TOUCH
    assert Fraction(toi[0]) >= hit.toi_lower - Fraction(1, 1000), "far too early"


@KINDS
def test_rows_do_not_depend_on_their_neighbours(is_face: bool, device: torch.device) -> None:
    rng = np.random.default_rng(6)
    start, end = rng.normal(size=(2, 3000, 4, 3))
    together = solve(start, end, is_face, device=device)
    order = rng.permutation(3000)
    apart = solve(start[order], end[order], is_face, device=device)
    alone = [solve(start[k : k + 1], end[k : k + 1], is_face, device=device) for k in range(20)]
    for column in range(3):
        assert np.array_equal(together[column][order], apart[column], equal_nan=True)
        assert np.array_equal(together[column][:20], np.concatenate([a[column] for a in alone]), equal_nan=True)
    assert (together[0] == pgccd.Status.TOUCH).sum() > 100


@KINDS
def test_no_queries(is_face: bool, device: torch.device) -> None:
    status, toi, coordinates = solve(np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), is_face, device=device)
    assert (status.shape, toi.shape, coordinates.shape) == ((0,), (0,), (0, 2))


@KINDS
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_no_number_is_never_free(is_face: bool, bad: float) -> None:
    rng = np.random.default_rng(7)
    start, end = rng.normal(size=(2, 24, 4, 3))
    for k in range(24):
        (start if k % 2 else end)[k].flat[k // 2] = bad
    assert (solve(start, end, is_face)[0] != pgccd.Status.FREE).all()
