"""The exact oracle with a minimum separation, and the distances: analytic cases and sampling both ways."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from . import adversarial, distance, separation
from .linear import Hit

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])
TRIANGLE = [[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]
CROSSED = [[0.0, -1, 0], [0, 1, 0]]


def first_within(start: object, end: object, s: float, is_face: bool) -> Hit | None:
    method = separation.vertex_face_within if is_face else separation.edge_edge_within
    return method(np.array(start, float), np.array(end, float), s)


@pytest.mark.parametrize(
    ("v0", "v1", "s", "toi"),
    [
        ([1, 1, 2], [1, 1, 0], 1.0, Fraction(1, 2)),
        ([1, 1, 2], [1, 1, 1], 1.0, 1),
        ([1, 1, 2], [1, 1, 1.0 + 2.0**-52], 1.0, None),
        ([1, 1, 0.5], [1, 1, 9], 1.0, 0),
        ([1, 1, 1], [2, 1, 1], 1.0, 0),  # at exactly the separation all the way
        ([-1, 1, 1], [3, 1, 1], 1.0, Fraction(1, 4)),  # comes over the edge at exactly the separation
        ([-1, 1, 1.25], [3, 1, 1.25], 1.0, None),
        ([-4, 1, 0], [0, 1, 0], 1.0, Fraction(3, 4)),  # towards an edge, in the plane
        ([-8, 0, 0], [0, 0, 0], 1.0, Fraction(7, 8)),  # towards a corner
        ([-3, -1, 0], [3, -1, 0], 1.0, Fraction(1, 2)),  # grazes the rounded corner, then stays at the separation
        ([-3, -1.25, 0], [3, -1.25, 0], 1.0, None),
    ],
)
def test_vertex_and_face_at_rest(v0: list[float], v1: list[float], s: float, toi: Fraction | int | None) -> None:
    hit = first_within([v0, *TRIANGLE], [v1, *TRIANGLE], s, True)
    assert (hit is None) == (toi is None)
    if hit is not None:
        assert toi is not None
        assert hit.toi_lower <= toi <= hit.toi_upper
    assert separation.touches_within([v0, *TRIANGLE], [v1, *TRIANGLE], s, True) == ("no" if toi is None else "yes")


@pytest.mark.parametrize(
    ("z0", "z1", "s", "toi"),
    [(2.0, 0.0, 0.5, Fraction(3, 4)), (2.0, 0.5, 0.5, 1), (2.0, 0.625, 0.5, None), (0.25, 2.0, 0.5, 0)],
)
def test_crossed_edges(z0: float, z1: float, s: float, toi: Fraction | int | None) -> None:
    hit = first_within([[-1, 0, z0], [1, 0, z0], *CROSSED], [[-1, 0, z1], [1, 0, z1], *CROSSED], s, False)
    assert (hit is None) == (toi is None)
    if hit is not None:
        assert toi is not None
        assert hit.toi_lower <= toi <= hit.toi_upper


def test_negative_separation_is_refused() -> None:
    with pytest.raises(ValueError, match="negative"):
        first_within([[0, 0, 1], *TRIANGLE], [[0, 0, 1], *TRIANGLE], -1.0, True)


@KINDS
def test_against_dense_sampling(is_face: bool) -> None:
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 1.0, 501)
    seen = {"yes": 0, "no": 0}
    for k in range(120):
        start, end, s = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), [0.05, 0.2, 0.5][k % 3]
        x = start + times[:, None, None] * (end - start)
        sampled = distance.min_distance_at(x, x, 0.0, is_face)
        hit = first_within(start, end, s, is_face)
        seen["no" if hit is None else "yes"] += 1
        if hit is None:
            assert sampled.min() > s - 1e-12
            continue
        assert sampled.min() <= s + 2 * np.linalg.norm(end - start, axis=1).max() / 500
        if hit.toi_upper == 0:
            assert sampled[0] <= s + 1e-12
        else:
            assert (sampled[times < float(hit.toi_lower) - 1e-9] > s - 1e-12).all()
            at = float(distance.squared_distance_exact(start, end, hit.toi_upper, is_face)) ** 0.5
            assert at == pytest.approx(s, abs=1e-14)
    assert min(seen.values()) > 10


@KINDS
def test_filtered_and_unfiltered_agree_and_a_larger_separation_is_reached_no_later(is_face: bool) -> None:
    q = adversarial.everything(np.random.default_rng(1), 4, is_face)
    last: list[Hit | None] = [None] * len(q.truth)
    for s in (0.0, 1e-9, 0.05):
        found = separation.within_many(q.points_t0, q.points_t1, s, is_face)
        for i, hit in enumerate(found):
            other = first_within(q.points_t0[i], q.points_t1[i], s, is_face)
            assert hit == other
            before = last[i]
            if before is not None:
                assert hit is not None and hit.toi_lower <= before.toi_upper
        last = found


@KINDS
def test_closest_approach_brackets_what_the_exact_method_says(is_face: bool) -> None:
    rng = np.random.default_rng(2)
    start, end = rng.normal(size=(60, 4, 3)), rng.normal(size=(60, 4, 3))
    lower, upper, at = separation.closest_approach(start, end, is_face)
    assert (upper - lower < 1e-9).all()
    for k in range(60):
        if lower[k] > 0:
            assert first_within(start[k], end[k], float(np.nextafter(lower[k], 0)), is_face) is None
        assert first_within(start[k], end[k], float(upper[k]), is_face) is not None
        square = distance.squared_distance_exact(start[k], end[k], float(at[k]), is_face)
        assert square <= Fraction(float(upper[k])) ** 2
    # Restricted to later times.
    late, _, when = separation.closest_approach(start, end, is_face, t_from=0.75)
    assert (late >= lower - 1e-9).all()
    assert (when >= 0.75).all()
    assert (late > lower + 0.1).any()


@KINDS
def test_distances_agree(is_face: bool) -> None:
    q = adversarial.everything(np.random.default_rng(3), 10, is_face)
    for t in (0.0, 0.375, 1.0):
        floats = distance.min_distance_at(q.points_t0, q.points_t1, t, is_face)
        for k, value in enumerate(floats):
            start, end = q.points_t0[k], q.points_t1[k]
            exact = distance.squared_distance_exact(start, end, t, is_face)
            size = max(np.ptp(start, axis=0).max(), np.ptp(end, axis=0).max())
            assert value == pytest.approx(float(exact) ** 0.5, abs=1e-12 * size, rel=1e-12)
            if t != 0.375:
                precise = distance.distance_high_precision((start if t == 0 else end).tolist(), is_face)
                assert float(precise) == pytest.approx(float(exact) ** 0.5, rel=1e-14, abs=1e-30)


def test_known_distances() -> None:
    at = lambda points, is_face: distance.min_distance_at(points, points, 0.0, is_face)[0]  # noqa: E731
    assert at([[1, 1, 3], *TRIANGLE], True) == 3
    assert at([[-3, 1, 4], *TRIANGLE], True) == 5
    assert at([[7, 0, 4], *TRIANGLE], True) == 5
    assert at([[-1, 0, 2], [1, 0, 2], *CROSSED], False) == 2
    assert at([[3, 0, 4], [9, 0, 4], *CROSSED], False) == 5
    assert at([[0, 5, 0], [0, 5, 0], *CROSSED], False) == 4
