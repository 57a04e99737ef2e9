"""The exact oracle of straight paths: analytic cases, constructed results, dense sampling, public ground truth."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from strategies import degenerate_features, feature_motions
from support.cases import few_and_many

from . import adversarial, distance, linear, separation
from .constructed import FREE, TOUCH, UNKNOWN

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])
TRIANGLE = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]


def first_touch(start: object, end: object, is_face: bool) -> linear.Hit | None:
    return (linear.vertex_face if is_face else linear.edge_edge)(np.array(start, float), np.array(end, float))


def many(start: np.ndarray, end: np.ndarray, is_face: bool) -> list[linear.Hit | None]:
    return (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)


@pytest.mark.parametrize(
    ("v0", "v1", "toi"),
    [
        ([1, 1, 1], [1, 1, -1], Fraction(1, 2)),
        ([1, 1, 1], [1, 1, -2], Fraction(1, 3)),
        ([1, 1, 1], [1, 1, 0], 1),
        ([1, 1, 0], [1, 1, 5], 0),
        ([1, 1, 1], [1, 1, 2.0**-1000], None),
        ([0, 0, 1], [0, 0, -1], Fraction(1, 2)),  # a corner
        ([2, 2, 1], [2, 2, -1], Fraction(1, 2)),  # an edge
        ([2, 2.0 + 2**-50, 1], [2, 2.0 + 2**-50, -1], None),
        ([-1, 1, 0], [3, 1, 0], Fraction(1, 4)),  # in the plane all the way
        ([-1, 5, 0], [5, -1, 0], Fraction(1, 6)),  # along the long edge
        ([-1, 5.5, 0], [5, -0.5, 0], None),
        ([-2, 0, 0], [8, 0, 0], Fraction(1, 5)),  # along an edge's line
        ([-1, -1, 0], [-2, -2, 0], None),
    ],
)
def test_vertex_meets_a_face_at_rest(v0: list[float], v1: list[float], toi: Fraction | int | None) -> None:
    hit = first_touch([v0, *TRIANGLE], [v1, *TRIANGLE], True)
    if toi is None:
        assert hit is None
    else:
        assert hit is not None
        assert hit.toi_lower <= toi <= hit.toi_upper
        assert hit.toi_upper - hit.toi_lower <= linear.WIDTH


@pytest.mark.parametrize(
    ("start", "end", "toi"),
    [
        (
            [[-1, 0, 1], [1, 0, 1], [0, -1, 0], [0, 1, 0]],
            [[-1, 0, -1], [1, 0, -1], [0, -1, 0], [0, 1, 0]],
            Fraction(1, 2),
        ),
        # end to end, on one line: gap 1 closing at speed 3
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], [[3, 0, 0], [4, 0, 0], [2, 0, 0], [3, 0, 0]], Fraction(1, 3)),
        # parallel, sinking onto each other
        (
            [[0, 0, 1], [1, 0, 1], [0.5, 0, 0], [3, 0, 0]],
            [[0, 0, -3], [1, 0, -3], [0.5, 0, 0], [3, 0, 0]],
            Fraction(1, 4),
        ),
        ([[0, 0, 1], [1, 0, 1], [1.5, 0, 0], [3, 0, 0]], [[0, 0, -3], [1, 0, -3], [1.5, 0, 0], [3, 0, 0]], None),
        # a point (zero-length edge) onto the middle of the other edge
        ([[1, 0, 1], [1, 0, 1], [0, 0, 0], [2, 0, 0]], [[1, 0, -1], [1, 0, -1], [0, 0, 0], [2, 0, 0]], Fraction(1, 2)),
        # two points that meet, and two that stay apart
        ([[1, 0, 0]] * 2 + [[0, 0, 0]] * 2, [[0, 0, 0]] * 2 + [[1, 0, 0]] * 2, Fraction(1, 2)),
        ([[1, 0, 0]] * 2 + [[0, 0, 0]] * 2, [[0, 0, 0]] * 2 + [[1, 1, 0]] * 2, None),
        # nothing moves
        ([[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]], 0),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]], None),
    ],
)
def test_edges(start: list[list[float]], end: list[list[float]], toi: Fraction | int | None) -> None:
    for order in ([0, 1, 2, 3], [1, 0, 2, 3], [2, 3, 0, 1], [3, 2, 1, 0]):
        hit = first_touch(np.array(start)[order], np.array(end)[order], False)
        assert (hit is None) == (toi is None)
        if hit is not None:
            assert toi is not None
            assert hit.toi_lower <= toi <= hit.toi_upper


def test_face_shrinks_to_a_segment_at_the_very_time_of_touch() -> None:
    # At t = 1/2 the face is the segment x in [-1, 1] on the x axis and the vertex is on it; before and after, the
    # vertex is off the face's plane.
    start = [[0.5, 0, -1], [-1, 0, 0], [1, 0, 0], [0, 1, 1]]
    end = [[0.5, 0, 1], [-1, 0, 0], [1, 0, 0], [0, -1, -1]]
    hit = first_touch(start, end, True)
    assert hit == linear.Hit(Fraction(1, 2), Fraction(1, 2))
    start[0][0] = end[0][0] = 1.5
    assert first_touch(start, end, True) is None


def test_irrational_time_is_bracketed_as_tightly_as_asked() -> None:
    # gap 1 - 2 t^2 between a turning plane z = 2 t x and a vertex at (t, ., 1)
    start = [[0, 0, 1], [-2, -2, 0], [2, -2, 0], [0, 4, 0]]
    end = [[1, 0, 1], [-2, -2, -4], [2, -2, 4], [0, 4, 0]]
    hit = linear.vertex_face(np.array(start, float), np.array(end, float), Fraction(1, 2**300))
    assert hit is not None
    assert hit.toi_upper - hit.toi_lower <= Fraction(1, 2**300)
    assert 2 * hit.toi_lower**2 < 1 < 2 * hit.toi_upper**2


@KINDS
@pytest.mark.parametrize("generator", adversarial.GENERATORS, ids=lambda g: g.__name__)
@few_and_many("count", 40, 80)
def test_adversarial(generator: adversarial.Generator, is_face: bool, count: int) -> None:
    """Constructed results hold; filtered, unfiltered and general methods agree; the order of points does not matter."""
    q = generator(np.random.default_rng(5), count, is_face)
    found = many(q.points_t0, q.points_t1, is_face)
    swap = [0, 3, 1, 2] if is_face else [3, 2, 0, 1]
    for i, hit in enumerate(found):
        start, end = q.points_t0[i], q.points_t1[i]
        if q.truth[i] != UNKNOWN:
            assert (hit is not None) == (q.truth[i] == TOUCH)
        if hit is not None and np.isfinite(q.toi[i]):
            assert hit.toi_lower <= Fraction(q.toi[i]) <= hit.toi_upper
        for other in (
            first_touch(start, end, is_face),
            first_touch(start[swap], end[swap], is_face),
            separation._first_within(start, end, 0.0, is_face, linear.WIDTH) if i % 3 == 0 else hit,
        ):
            assert (other is None) == (hit is None)
            if hit is not None and other is not None:
                assert hit.toi_lower <= other.toi_upper and other.toi_lower <= hit.toi_upper
    assert {bool(t) for t in q.truth} <= {bool(TOUCH), bool(FREE), bool(UNKNOWN)}


@KINDS
@pytest.mark.parametrize("generator", [adversarial.random, adversarial.contact_at, adversarial.one_point])
def test_against_dense_sampling(generator: adversarial.Generator, is_face: bool) -> None:
    q = generator(np.random.default_rng(6), 150, is_face)
    times = np.linspace(0.0, 1.0, 401)
    hits = 0
    for start, end, hit in zip(q.points_t0, q.points_t1, many(q.points_t0, q.points_t1, is_face), strict=True):
        x = start + times[:, None, None] * (end - start)
        size = float(np.abs(x).max())
        sampled = distance.min_distance_at(x, x, 0.0, is_face)
        # The distance changes no faster than the points' relative velocity.
        step = end - start
        fastest = 2 * float(np.linalg.norm(step - step.mean(axis=0), axis=1).max())
        if hit is None:
            p, a, b, c = (x[:, k] for k in range(4))
            normal = np.cross(b - a, c - a) if is_face else np.cross(a - p, c - b)
            volume = ((p - a) * normal).sum(axis=1) if is_face else ((b - p) * normal).sum(axis=1)
            uv = distance.closest_coordinates(x, is_face)
            inner = (uv > 0.05).all(axis=1) & ((uv.sum(axis=1) < 0.95) if is_face else (uv < 0.95).all(axis=1))
            crossing = (volume[:-1] * volume[1:] < 0) & inner[:-1] & inner[1:]
            assert not (crossing & (sampled[:-1] < 0.01 * size) & (sampled[1:] < 0.01 * size)).any()
            continue
        hits += 1
        assert sampled.min() <= fastest / 400 + 1e-12 * size
        before = times < float(hit.toi_lower) - 1e-6
        assert (sampled[before] > 0).all()
        square = distance.squared_distance_exact(start, end, hit.toi_upper, is_face)
        assert float(square) ** 0.5 <= float(linear.WIDTH) * fastest * 2
    assert hits >= 3


@KINDS
def test_free_queries_stay_apart(is_face: bool) -> None:
    q = adversarial.everything(np.random.default_rng(7), 30, is_face)
    free = np.array([hit is None for hit in many(q.points_t0, q.points_t1, is_face)])
    lower, upper, _ = separation.closest_approach(q.points_t0, q.points_t1, is_face)
    size = np.maximum(np.abs(q.points_t0), np.abs(q.points_t1)).max(axis=(1, 2))
    assert not (lower[~free] > 0).any()  # touching primitives are never proven apart
    apart = lower > 0
    assert (apart[free]).mean() > 0.8  # and most of the others are
    assert (upper[~free] < 1e-6 * size[~free]).all()


@settings(max_examples=150, deadline=None)
@given(degenerate_features())
def test_degenerate_features_agree_with_the_general_method(points: tuple[np.ndarray, np.ndarray]) -> None:
    for is_face in (True, False):
        hit = first_touch(*points, is_face)
        other = separation._first_within(*points, 0.0, is_face, linear.WIDTH)
        assert (hit is None) == (other is None)
        if hit is not None and other is not None:
            assert hit.toi_lower <= other.toi_upper and other.toi_lower <= hit.toi_upper
        for t in (Fraction(0), Fraction(1, 3), Fraction(1)):
            if distance.squared_distance_exact(*points, t, is_face) == 0:
                assert hit is not None and hit.toi_lower <= t


@settings(max_examples=100, deadline=None)
@given(feature_motions(2))
def test_reversed_time_touches_too(points: tuple[np.ndarray, np.ndarray]) -> None:
    for is_face in (True, False):
        forward, back = first_touch(*points, is_face), first_touch(points[1], points[0], is_face)
        assert (forward is None) == (back is None)
        if forward is not None and back is not None:
            assert forward.toi_lower <= 1 - back.toi_lower


def data() -> Path:
    root = os.environ.get("PGCCD_CCD_DATA")
    if not root:
        pytest.skip("PGCCD_CCD_DATA is not set")
    return Path(root)


def test_public_queries() -> None:
    """Wang et al. 2021, Sample-Queries."""
    paths = sorted((data() / "queries").glob("*.npz"))
    assert paths
    for path in paths:
        with np.load(path) as file:
            points, truth = file["points"], file["collides"]
        is_face = path.stem.endswith(".vf")
        found = [hit is not None for hit in many(points[:, :4], points[:, 4:], is_face)]
        assert np.array_equal(found, truth), path.name
        every = [first_touch(p[:4], p[4:], is_face) is not None for p in points]
        assert np.array_equal(every, truth), path.name


@pytest.mark.parametrize("at_most", [400])
def test_public_scenes(at_most: int) -> None:
    """Belgrod et al. 2023: every near miss, and a sample of the colliding pairs, evenly spread."""
    paths = sorted((data() / "scenes").glob("*.npz"))
    assert paths
    for path in paths:
        with np.load(path) as file:
            scene = {key: file[key] for key in file.files}
        for kind in ("vf", "ee"):
            pairs, truth = scene[f"{kind}_pairs"], scene[f"{kind}_collides"]
            chosen = np.union1d(
                np.arange(0, len(pairs), max(1, len(pairs) // at_most)), np.flatnonzero(~truth)[:at_most]
            )
            pairs, truth = pairs[chosen], truth[chosen]
            if kind == "vf":
                index = np.concatenate([pairs[:, :1], scene["faces"][pairs[:, 1]]], axis=1)
            else:
                index = scene["edges"][pairs].reshape(-1, 4)
            found = many(scene["vertices_t0"][index], scene["vertices_t1"][index], kind == "vf")
            assert np.array_equal([hit is not None for hit in found], truth), (path.name, kind)
