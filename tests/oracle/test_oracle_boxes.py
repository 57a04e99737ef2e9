"""Gaps of boxes, against known ones and linear programs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from .boxes import axes_of, least_gap

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
HALF = np.array([0.5, 0.3, 0.15])


def turned(axis: int, degrees: float) -> list[float]:
    angle = np.radians(degrees) / 2
    return [np.cos(angle), *(np.sin(angle) * np.eye(3)[axis])]


@pytest.mark.parametrize(
    ("offset", "first", "second", "gap"),
    [
        ([1.15, 0.0, 0.0], UPRIGHT, UPRIGHT, 0.15),
        ([0.75, 0.0, 0.0], UPRIGHT, UPRIGHT, -0.25),
        ([0.0, 0.0, 0.2], UPRIGHT, UPRIGHT, -0.1),
        ([1.0, 0.0, 0.0], UPRIGHT, turned(2, 90.0), 0.2),
        # Edges against each other, at right angles.
        ([0.0, 0.0, 0.8], turned(0, 45.0), turned(1, 45.0), 0.8 - (0.45 + 0.65) / np.sqrt(2.0)),
    ],
)
def test_known_gaps(offset: list[float], first: list[float], second: list[float], gap: float) -> None:
    place = np.array([[3.0, -1.0, 2.0]])
    found = least_gap(np.concatenate([place, place + offset]), np.array([first, second]), HALF)
    assert found == pytest.approx(gap, abs=1e-12)


def test_far_boxes() -> None:
    assert least_gap(np.array([[0.0, 0, 0], [9, 0, 0]]), np.array([UPRIGHT] * 2), HALF) == np.inf


def have_common_point(position: np.ndarray, axes: np.ndarray) -> bool:
    """Whether two boxes have, by a linear program."""
    rows = np.concatenate([axes[0], axes[1]])
    centre = np.concatenate([axes[0] @ position[0], axes[1] @ position[1]])
    reach = np.tile(HALF, 2)
    bound = np.concatenate([centre + reach, reach - centre])
    found = linprog(np.zeros(3), A_ub=np.concatenate([rows, -rows]), b_ub=bound, bounds=[(None, None)] * 3)
    return found.status == 0


def test_signs_of_random_gaps() -> None:
    rng = np.random.default_rng(4)
    seen = set()
    for _ in range(200):
        orientation = rng.normal(size=(2, 4))
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        position = np.stack([np.zeros(3), rng.uniform(-0.7, 0.7, size=3)])
        gap = least_gap(position, orientation, HALF)
        if abs(gap) > 1e-6:
            assert have_common_point(position, axes_of(orientation)) == (gap < 0.0)
            seen.add(gap < 0.0)
    assert seen == {False, True}
