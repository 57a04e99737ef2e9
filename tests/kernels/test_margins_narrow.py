"""Margins of the narrow phase: contacts exactly at the limit of being reported, and some just beyond it.

Queries are constructed and then measured exactly (or to 50 digits, on arcs); the requested separation is the float64
next to that distance. A bound that is one rounding too small would miss the contact.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from oracle import linear, separation
from oracle.constructed import touching_points
from strategies import contacts
from support.shapes import directions, turned, unit_quaternions

import pgccd

KINDS = pytest.mark.parametrize("is_face", [True, False], ids=["vf", "ee"])


def ask(
    start: np.ndarray,
    end: np.ndarray,
    is_face: bool,
    min_separation: float = 0.0,
    tolerance: float = 0.0,
    dtype: torch.dtype = torch.float64,
) -> pgccd.ElementaryResult:
    """Solves elementary queries (n, 4, 3) or one (4, 3)."""
    points = [torch.tensor(x.reshape(-1, 4, 3), dtype=dtype) for x in (start, end)]
    test = pgccd.narrow.vertex_face if is_face else pgccd.narrow.edge_edge
    return test(*points, min_separation, tolerance)


# Straight paths, with each query's own distance as separation.


def shapes(rng: np.random.Generator, n: int, is_face: bool, scale: float = 1.0) -> np.ndarray:
    """Disjoint features (n, 4, 3), half with nearest points inside both, half with nearest points on boundaries."""
    points = rng.normal(size=(n, 4, 3))
    inside = touching_points(rng, n, is_face, False)
    turn = unit_quaternions(rng, n)
    v, w = turn[:, None, 1:], turn[:, None, :1]
    inside = inside + 2 * np.cross(v, np.cross(v, inside) + w * inside)
    normal = np.cross(inside[:, -1] - inside[:, -2], inside[:, -1] - inside[:, 1])
    if is_face:
        normal = np.cross(inside[:, 2] - inside[:, 1], inside[:, 3] - inside[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lifted = slice(0, 1) if is_face else slice(0, 2)
    inside[:, lifted] += (rng.uniform(0.01, 2.0, (n, 1)) * normal)[:, None]
    half = (np.arange(n) % 2 == 0)[:, None, None]
    return scale * np.where(half, points, inside)


def coming_to_rest(rng: np.random.Generator, n: int, is_face: bool) -> tuple[np.ndarray, np.ndarray]:
    """Features (n, 4, 3) at both ends of straight paths on which they come closer."""
    end = shapes(rng, n, is_face)
    start = end.copy()
    moved = slice(0, 1) if is_face else slice(0, 2)
    start[:, moved] = start[:, moved] + 3.0 * (start[:, moved] - start[:, 2:3]) * rng.uniform(0.1, 1.0, (n, 1, 1))
    return start, end


def assert_found_at_its_own_distance(start: np.ndarray, end: np.ndarray, t: float, is_face: bool) -> None:
    """Asserts that every query of (n, 4, 3) is found with its distance at t as separation."""
    for k in range(len(start)):
        least = contacts.separation_at(start[k], end[k], t, is_face)
        found = ask(start[k], end[k], is_face, least)
        assert int(found.status) != pgccd.Status.FREE, f"query {k} is missed"
        assert float(found.toi) <= t, f"query {k} is late"


@KINDS
@pytest.mark.parametrize("scale", [0, -62, -64, -66, 41, 42, 43])
def test_resting_features(is_face: bool, scale: int) -> None:
    """At sizes well within float32, and at sizes whose products nearly underflow or overflow."""
    n = 160 if scale == 0 else 60
    points = shapes(np.random.default_rng([1, abs(scale)]), n, is_face, 2.0**scale)
    assert_found_at_its_own_distance(points, points, 0.0, is_face)


@KINDS
@pytest.mark.parametrize("separation", [2.0**-10, 0.25, 1.0, 64.0])
def test_features_at_rest_along_an_axis(is_face: bool, separation: float) -> None:
    """Where the sum of a direction's coordinates is its length, distances are compared without a margin."""
    rng = np.random.default_rng(8)
    points = touching_points(rng, 120, is_face, False)
    points[:, slice(0, 1) if is_face else slice(0, 2), 2] += separation
    for axis in range(3):
        turned_over = np.roll(points, axis, axis=2)
        assert bool((ask(turned_over, turned_over, is_face, separation).toi == 0.0).all())


@KINDS
def test_features_that_come_to_rest(is_face: bool) -> None:
    """Features approach each other along straight lines and meet at the end of the step, not before."""
    start, end = coming_to_rest(np.random.default_rng(2), 160, is_face)
    assert_found_at_its_own_distance(start, end, 1.0, is_face)


@KINDS
def test_growing_features(is_face: bool) -> None:
    """The cubic is compared with the length of a growing normal."""
    rng = np.random.default_rng(3)
    end = shapes(rng, 120, is_face)[1::2]
    middle = end.mean(axis=1, keepdims=True)
    start = middle + (end - middle) * rng.uniform(0.1, 0.3, (len(end), 1, 1))
    lifted = slice(0, 1) if is_face else slice(0, 2)
    normal = np.cross(end[:, 2] - end[:, 1], end[:, 3] - end[:, 1]) if is_face else None
    if normal is None:
        normal = np.cross(end[:, 1] - end[:, 0], end[:, 3] - end[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    side = np.sign(((end[:, 0] - end[:, 2]) * normal).sum(axis=1))[:, None, None]
    start[:, lifted] += 2.0 * side * normal[:, None]
    assert_found_at_its_own_distance(start, end, 1.0, is_face)


@KINDS
def test_corners_so_small_that_products_underflow(is_face: bool) -> None:
    """Corners closer than the separation; float32 represents the features' sizes, but not their squares."""
    rng = np.random.default_rng(15)
    n = 300_000
    size, separation = (2.0**-74, 2.0**-74 * 0.1) if is_face else (2.0**-76, 2.0**-76)
    way = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-3, 0, (n, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    points = np.zeros((n, 4, 3))
    points[:, 1 if is_face else 2] = corner = separation * (1 - 1e-7) * way
    if is_face:
        points[:, 2:] = corner[:, None] + size * (way[:, None] + 0.5 * rng.normal(size=(n, 2, 3)))
    else:
        points[:, 1] = -size * (way + 0.3 * rng.normal(size=(n, 3)))
        points[:, 3] = corner + size * (way + 0.3 * rng.normal(size=(n, 3)))
    assert bool((ask(points, points, is_face, separation).toi == 0.0).all())


def four_squares(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """A 53-bit integer vector with integer length."""
    m, n, p, q = (int(x) for x in rng.integers(2**24, 2**25, 4))
    x = [m * m + n * n - p * p - q * q, 2 * (m * q + n * p), 2 * (n * q - m * p)]
    return np.array(x, dtype=np.float64), float(m * m + n * n + p * p + q * q)


@KINDS
def test_corners_at_distances_that_are_exact(is_face: bool) -> None:
    """At rest at exactly the separation, along directions that are inexact in every precision: the last one must find
    it.
    """
    rng = np.random.default_rng(4)
    for k in range(120):
        offset, length = four_squares(rng)
        points = np.zeros((4, 3))
        # The other vertices lie behind the two corners.
        points[2] = offset
        side = np.round(np.cross(offset, rng.normal(size=3)))
        points[1 if is_face else 3] = np.round(1.5 * offset + 0.25 * side)
        points[3 if is_face else 1] = np.round((1.75 if is_face else -0.5) * offset - 0.25 * side)
        points *= 2.0**-52
        found = ask(points, points, is_face, length * 2.0**-52)
        assert int(found.status) != pgccd.Status.FREE and float(found.toi) == 0.0, f"query {k} is missed"
        far = ask(points, points, is_face, np.nextafter(length * 2.0**-52, 0.0))
        assert int(far.status) == pgccd.Status.FREE, f"query {k} is further apart than the separation"


# Certificates of touching.


def hardly(rng: np.random.Generator, n: int, is_face: bool, boundary: bool) -> tuple[np.ndarray, np.ndarray]:
    """Queries (n, 4, 3) decided by rounding: a vertex or an edge that ends in the other's plane, inside, or that
    crosses the plane exactly at a boundary; at random times and in random directions.
    """
    flat = touching_points(rng, n, is_face, boundary)
    turn = unit_quaternions(rng, n)
    v, w = turn[:, None, 1:], turn[:, None, :1]
    flat = flat + 2 * np.cross(v, np.cross(v, flat) + w * flat)
    # Half of them along the projection axis of the plane, so that a crossing at a boundary stays on it.
    normal = turned(turn, np.tile([0.0, 0.0, 1.0], (n, 1)))
    axis = np.eye(3)[np.abs(normal).argmax(axis=1)][:, None]
    travel = np.where(rng.random((n, 1, 1)) < 0.5, rng.normal(size=(n, 1, 3)), axis)
    moved = slice(0, 1) if is_face else slice(0, 2)
    t = rng.uniform(0.2, 0.8, (n, 1, 1)) if boundary else 1.0
    start, end = flat.copy(), flat.copy()
    start[:, moved] -= t * travel
    end[:, moved] += (1.0 - t) * travel
    return start, end


@KINDS
@pytest.mark.parametrize("boundary", [False, True])
@pytest.mark.parametrize("tolerance", [1e-6, 0.0])
def test_proofs_of_touching_are_right(is_face: bool, boundary: bool, tolerance: float) -> None:
    """Features certified in float64 as touching do touch; features that miss by less than the tolerance are free."""
    start, end = hardly(np.random.default_rng(5), 400, is_face, boundary)
    found = ask(start, end, is_face, tolerance=tolerance)
    hits = (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)
    touching = np.array([hit is not None for hit in hits])
    status = found.status.numpy()
    assert 50 < touching.sum() < 350
    assert (status[touching] != pgccd.Status.FREE).all(), "missed"
    assert (status[~touching] == pgccd.Status.FREE).all(), "a near miss is no contact"
    assert all(Fraction(float(t)) <= hit.toi_upper for t, hit in zip(found.toi, hits, strict=True) if hit)


@pytest.mark.parametrize("beyond", range(4))
def test_edges_that_cross_just_beyond_an_end_are_free(beyond: int) -> None:
    """Each passes the other's line, one of them by less than the tolerance beyond one of its ends."""
    rng = np.random.default_rng(9)
    n = 200
    turn = unit_quaternions(rng, n)
    axes = np.stack([turned(turn, np.tile(axis, (n, 1))) for axis in np.eye(3)], axis=1)
    angle = rng.uniform(0.5, 2.5, (n, 1))
    along = [axes[:, 0], np.cos(angle) * axes[:, 0] + np.sin(angle) * axes[:, 1]]
    part = rng.uniform(0.2, 0.8, (n, 2))
    part[:, beyond // 2] = beyond % 2 + (beyond % 2 - 0.5) * 10.0 ** rng.uniform(-8, -4, n)
    start = np.stack([(x - part[:, k, None]) * along[k] for k in (0, 1) for x in (0.0, 1.0)], axis=1)
    end = start.copy()
    start[:, :2] += axes[:, 2:]
    end[:, :2] -= rng.uniform(0.5, 2.0, (n, 1, 1)) * axes[:, 2:]
    assert bool((ask(start, end, False, tolerance=1e-3).status == pgccd.Status.FREE).all())


@KINDS
def test_proofs_of_coming_within_the_separation_are_right(is_face: bool) -> None:
    """Features that stay one rounding further apart than the separation are free."""
    start, end = coming_to_rest(np.random.default_rng(6), 120, is_face)
    for k in range(120):
        too_small = float(np.nextafter(contacts.separation_at(start[k], end[k], 1.0, is_face), 0.0))
        if separation.within_many(start[k][None], end[k][None], too_small, is_face)[0] is None:
            assert int(ask(start[k], end[k], is_face, too_small, 1e-6).status) == pgccd.Status.FREE


@KINDS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_toi_is_rounded_down(is_face: bool, dtype: torch.dtype) -> None:
    """Without a tolerance the toi is the true one to full precision of the last arithmetic."""
    rng = np.random.default_rng(7)
    start, end = hardly(rng, 400, is_face, True)
    if dtype == torch.float32:
        start, end = (x.astype(np.float32).astype(np.float64) for x in (start, end))
    found = ask(start, end, is_face, tolerance=0.0, dtype=dtype)
    hits = (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)
    late = [k for k, hit in enumerate(hits) if hit and Fraction(float(found.toi[k])) > hit.toi_upper]
    assert late == [] and sum(hit is not None for hit in hits) > 50


@KINDS
@pytest.mark.parametrize("speed", [2.0**10, 2.0**20, 2.0**30])
def test_fast_features_are_not_late(is_face: bool, speed: float) -> None:
    """Starting so far away that their positions, and the time of contact, have few digits."""
    rng = np.random.default_rng(16)
    n = 200
    flat = touching_points(rng, n, is_face, False)
    turn = unit_quaternions(rng, n)
    v, w = turn[:, None, 1:], turn[:, None, :1]
    flat = flat + 2 * np.cross(v, np.cross(v, flat) + w * flat)
    travel, t = speed * rng.normal(size=(n, 1, 3)), rng.uniform(0.1, 0.9, (n, 1, 1))
    start, end = flat.copy(), flat.copy()
    moved = slice(0, 1) if is_face else slice(0, 2)
    start[:, moved] -= t * travel
    end[:, moved] += (1.0 - t) * travel
    hits = (linear.vertex_face_many if is_face else linear.edge_edge_many)(start, end)
    assert sum(hit is not None for hit in hits) > n // 2
    for tolerance in (0.0, 1e-6):
        found = ask(start, end, is_face, tolerance=tolerance)
        for k, hit in enumerate(hits):
            if hit is not None:
                assert int(found.status[k]) != pgccd.Status.FREE, f"query {k} is missed"
                assert Fraction(float(found.toi[k])) <= hit.toi_upper, f"query {k} is late"


@KINDS
def test_slender_features_are_measured_by_their_boundaries(is_face: bool) -> None:
    """Nearly collinear corners, nearly parallel edges: their normal is mostly rounding, and is not used."""
    rng = np.random.default_rng(8)
    n = 300
    points = rng.normal(size=(n, 4, 3))
    along = directions(rng, n)
    if is_face:
        points[:, 2] = points[:, 1] + along
        points[:, 3] = points[:, 1] + rng.uniform(-1, 1, (n, 1)) * along
    else:
        points[:, 1], points[:, 3] = points[:, 0] + along, points[:, 2] + along
    points += 2.0**-53 * rng.integers(-2, 3, points.shape)
    least = [contacts.separation_at(p, p, 0.0, is_face) for p in points]
    for k in range(n):
        assert int(ask(points[k], points[k], is_face, 0.5 * least[k], 1e-6).status) == pgccd.Status.FREE
        assert int(ask(points[k], points[k], is_face, least[k], 1e-6).status) != pgccd.Status.FREE
