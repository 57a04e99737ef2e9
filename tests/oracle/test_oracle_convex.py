"""Separating axes of convex bodies, against cases that are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from oracle.boxes import axes_of, least_gap
from oracle.convex import Convex, gap

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
CUBE = Convex.of_mesh(_CORNERS, np.array([*_FACES, [1, 5, 7], [1, 7, 3]]))


def test_random_boxes() -> None:
    """Against the oracle of equal boxes; a third of the gaps is found along edges that cross."""
    rng = np.random.default_rng(0)
    half, seen = np.array([1.0, 0.5, 0.2]), []
    box = Convex.of_mesh(_CORNERS * half, np.array([*_FACES, [1, 5, 7], [1, 7, 3]]))
    for _ in range(300):
        orientation = rng.normal(size=(2, 4))
        orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
        position = rng.normal(size=(2, 3)) * 0.7
        a, b = (box.placed(*pose) for pose in zip(axes_of(orientation), position, strict=True))
        found, expected = gap(a, b), least_gap(position, orientation, half)
        assert (found > 0.0) == (expected > 0.0)
        assert found > 0.0 or found == pytest.approx(expected, abs=1e-9)
        seen.append(expected > 0.0)
    assert 50 < sum(seen) < 250


def test_crossed_edges() -> None:
    """Cubes with an edge up and an edge down, which cross: only the cross product of edges separates them."""
    turns = [[np.cos(np.pi / 8), *(np.sin(np.pi / 8) * np.eye(3)[axis])] for axis in (0, 1)]
    below, above = axes_of(np.array(turns))
    for more in (0.01, -0.01):
        raised = CUBE.placed(above, np.array([0.0, 0.0, 2.0 * np.sqrt(2.0) + more]))
        assert np.sign(gap(CUBE.placed(below, np.zeros(3)), raised)) == np.sign(more)


def test_a_triangle() -> None:
    triangle = Convex.of_mesh(np.array([[0.0, 0, 1.2], [3, 0, 1.2], [0, 3, 1.2]]), np.array([[0, 1, 2]]))
    assert gap(CUBE, triangle) > 0.0
    assert gap(CUBE.placed(np.eye(3), np.array([0.0, 0.0, 0.3])), triangle) == pytest.approx(-0.1)
