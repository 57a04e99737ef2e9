"""Margins of the broad phase: spheres that touch to float64 precision, or nearly so."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from oracle.broad import spheres_meet
from support.broad_phases import agreed, check
from support.shapes import directions, tensors

from pgccd import ops


def least_radius(start: np.ndarray, end: np.ndarray, other: float) -> float:
    """The least radius with which a sphere just touches another, centres (2, 3) at both ends."""
    offset = [start[1] - start[0], end[1] - end[0]]
    travel = offset[1] - offset[0]
    square = float(travel @ travel)
    nearest = min(max(-float(offset[0] @ travel) / square, 0.0), 1.0) if square else 0.0
    found = float(np.linalg.norm(offset[0] + nearest * travel)) - other
    step = np.spacing(max(abs(start).max(), abs(end).max()))
    low, high = found - 64 * step, found + 64 * step
    assert not spheres_meet(start, end, other, low) and spheres_meet(start, end, other, high)
    while np.nextafter(low, high) < high:
        middle = float(0.5 * (low + high))
        low, high = (low, middle) if spheres_meet(start, end, other, middle) else (middle, high)
    return high


@pytest.mark.parametrize("travel", [0.0, 1.0, 1e3, 1e6])
def test_spheres_that_just_touch(device: torch.device, travel: float) -> None:
    """Also fast ones that pass each other far from where they start. Each pair is in its own world."""
    rng = np.random.default_rng([1, int(travel)])
    n = 100
    start = rng.normal(size=(n, 2, 3)) * max(travel, 1.0)
    way = travel * rng.normal(size=(n, 3))
    aside = np.cross(directions(rng, n), directions(rng, n) if travel == 0 else way / np.maximum(travel, 1.0))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    start[:, 1] = start[:, 0] + rng.uniform(0.5, 2.0, (n, 1)) * aside - 0.4 * way
    end = start.copy()
    end[:, 1] += way
    radius = np.array([[0.25, least_radius(start[k], end[k], 0.25)] for k in range(n)])
    worlds = np.repeat(np.arange(n), 2)
    found = agreed(start.reshape(-1, 3), end.reshape(-1, 3), radius.ravel(), device=device, world=worlds)
    assert found.tolist() == [[2 * k, 2 * k + 1] for k in range(n)]


def test_boxes_hold_what_the_predicate_lets_in() -> None:
    """The predicate has a margin for rounding; boxes need a larger one, otherwise the broad phases would differ."""
    for axis in range(3):
        side = (axis + 1) % 3
        for k in range(6):
            radius = np.array([1.0, 1.0 + k / 8.0])
            # At rest, their distance exceeds the sum of radii by less than the predicate's margin.
            start = np.zeros((2, 3))
            start[1, axis] = radius.sum() * (1.0 + 2.0**-49)
            overlap(start, start, radius, 0.0)
            # Fast and small, side by side; the excess is less than the margin for their travel.
            start, end = np.zeros((2, 3)), np.zeros((2, 3))
            end[:, axis] = 2.0**20, -(2.0**20)
            small = radius * 2.0**-4
            start[1, side] = end[1, side] = small.sum() + 2.0**-29
            overlap(start, end, small, 0.0)


@pytest.mark.parametrize("separation", [0.75, 1.0 / 3.0])
def test_boxes_hold_their_share_of_the_separation(separation: float) -> None:
    for axis in range(3):
        start = np.zeros((2, 3))
        start[1, axis] = 0.5 + separation
        overlap(start, start, np.array([0.25, 0.25]), separation)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_boxes_hold_points_that_vanish(axis: int) -> None:
    """The predicate lets in all that are nearer than 2^-500, whose squares may underflow."""
    start = np.zeros((2, 3))
    start[1, axis] = 0.9 * 2.0**-500
    overlap(start, start, np.zeros(2), 0.0)


def overlap(start: np.ndarray, end: np.ndarray, radius: np.ndarray, separation: float) -> None:
    """Asserts that the pair is found, and that the boxes overlap."""
    assert agreed(start, end, radius, separation).tolist() == [[0, 1]]
    lower, upper = (x.numpy() for x in ops.swept_boxes(tensors(start, end, radius), separation, 0.0))
    assert (lower[0] <= upper[1]).all() and (lower[1] <= upper[0]).all()


def touching_pairs(rng: np.random.Generator, n: int, spread: float, along_axes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Spheres (2 n) scattered over a scene; each pair just touches."""
    first = spread * rng.uniform(-1, 1, (n, 3))
    way = np.eye(3)[rng.integers(0, 3, n)] * rng.choice([-1.0, 1.0], (n, 1)) if along_axes else directions(rng, n)
    centre = np.stack([first, first + way * rng.uniform(0.5, 2.0, (n, 1))], axis=1)
    radius = np.empty((n, 2))
    for k in range(n):
        radius[k, 0] = 0.25 + 0.2 * rng.random()
        radius[k, 1] = least_radius(centre[k], centre[k], radius[k, 0])
    return centre.reshape(-1, 3), radius.ravel()


@pytest.mark.parametrize("along_axes", [False, True])
@pytest.mark.parametrize("spread", [1.0, 30.0, 1e3, 1e5])
def test_touching_spheres_in_a_wide_scene(device: torch.device, spread: float, along_axes: bool) -> None:
    """Boxes and spheres are compared in float32 first, which resolves their positions less and less."""
    centre, radius = touching_pairs(np.random.default_rng([2, int(spread)]), 150, spread, along_axes)
    assert len(check(centre, centre, radius, device=device)) >= 150


@pytest.mark.parametrize("along_axes", [False, True])
@pytest.mark.parametrize("exponent", [-73, -75, -130, -136, -140, -535, -536, -537, -538])
def test_touching_spheres_of_tiny_size(exponent: int, along_axes: bool) -> None:
    """Squares, or the numbers themselves, lose digits to underflow: in float32, or in float64."""
    centre, radius = touching_pairs(np.random.default_rng([3, -exponent]), 60, 8.0, along_axes)
    scale = 2.0**exponent
    found = agreed(scale * centre, scale * centre, scale * radius)
    assert {(2 * k, 2 * k + 1) for k in range(60)} <= {tuple(p) for p in found.tolist()}


@pytest.mark.parametrize("along_axes", [False, True])
@pytest.mark.parametrize("travel", [0.0, 1.0, 1e3, 1e6])
def test_spheres_that_just_touch_at_two_times(device: torch.device, travel: float, along_axes: bool) -> None:
    """The first one ends where it just touches the other's start, and the other goes on: they are never so near at
    equal times.
    """
    rng = np.random.default_rng([4, int(travel)])
    n = 100
    way = np.eye(3)[rng.integers(0, 3, n)] if along_axes else directions(rng, n)
    met = rng.normal(size=(n, 3))
    met = np.stack([met, met + rng.uniform(0.5, 2.0, (n, 1)) * way], axis=1)
    start, end = met.copy(), met.copy()
    start[:, 0] -= travel * rng.uniform(0.5, 1.0, (n, 1)) * way
    end[:, 1] += travel * rng.uniform(0.5, 1.0, (n, 1)) * way
    radius = np.array([[0.25, least_radius(met[k], met[k], 0.25)] for k in range(n)])
    given = start.reshape(-1, 3), end.reshape(-1, 3), radius.ravel()
    worlds = np.repeat(np.arange(n), 2)
    found = agreed(*given, device=device, world=worlds, at_any_times=True)
    assert found.tolist() == [[2 * k, 2 * k + 1] for k in range(n)]
    # With a separation, and for points.
    apart = given[0], given[1], 0.0 * given[2]
    gaps = float(radius.sum(axis=1).max())
    assert len(agreed(*apart, gaps, device=device, world=worlds, at_any_times=True)) == n
    assert travel == 0.0 or len(agreed(*given, device=device, world=worlds)) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_points_that_vanish_at_any_times(axis: int) -> None:
    start = np.zeros((2, 3))
    start[1, axis] = 0.9 * 2.0**-500
    assert agreed(start, start, np.zeros(2)).tolist() == [[0, 1]]
    assert agreed(start, start, np.zeros(2), at_any_times=True).tolist() == [[0, 1]]


def test_least_radius_is_least() -> None:
    start, end = np.zeros((2, 3)), np.zeros((2, 3))
    start[1], end[1] = [-3.0, 3.0, 4.0], [5.0, 3.0, 4.0]
    assert least_radius(start, end, 2.0) == 3.0
    assert Fraction(least_radius(start, end, 0.1)) + Fraction(0.1) >= 5
