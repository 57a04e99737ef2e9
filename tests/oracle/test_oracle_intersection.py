"""Exact intersection of triangles at rest: known cases, and another method on many degenerate ones."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from . import intersection
from .intersection import as_integers, crossings, have_common_point

Row = list[Fraction]


def meet_by_elimination(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two triangles (3, 3) have a common point, by linear programming: a0 + s (a1 - a0) + t (a2 - a0) = b0 +
    u (b1 - b0) + v (b2 - b0) with s, t, u, v >= 0, s + t <= 1 and u + v <= 1 has a solution. Equations are
    substituted, then Fourier-Motzkin elimination decides.
    """
    (a0, a1, a2), (b0, b1, b2) = ([[Fraction(int(c)) for c in x] for x in triangle] for triangle in (a, b))
    # Coefficients of s, t, u, v, and a constant: sums that are zero, and sums that are not negative.
    equations: list[Row] = [
        [a1[k] - a0[k], a2[k] - a0[k], b0[k] - b1[k], b0[k] - b2[k], a0[k] - b0[k]] for k in range(3)
    ]
    signs = [(1, 0, 0, 0, 0), (0, 1, 0, 0, 0), (0, 0, 1, 0, 0), (0, 0, 0, 1, 0), (-1, -1, 0, 0, 1), (0, 0, -1, -1, 1)]
    conditions: list[Row] = [[Fraction(c) for c in row] for row in signs]

    def less(row: Row, factor: Fraction, other: Row) -> Row:
        return [x - factor * y for x, y in zip(row, other, strict=True)]

    for unknown in range(4):
        pivot = next((row for row in equations if row[unknown] != 0), None)
        if pivot is not None:
            equations = [less(row, row[unknown] / pivot[unknown], pivot) for row in equations if row is not pivot]
            conditions = [less(row, row[unknown] / pivot[unknown], pivot) for row in conditions]
            continue
        lower, upper = ([row for row in conditions if side * row[unknown] > 0] for side in (1, -1))
        conditions = [row for row in conditions if row[unknown] == 0]
        conditions += [less(low, low[unknown] / high[unknown], high) for low, high in product(lower, upper)]
    return all(row[4] == 0 for row in equations) and all(row[4] >= 0 for row in conditions)


def check(a: np.ndarray, b: np.ndarray) -> float:
    """Compares both methods, both kinds of integers and both orders; returns the fraction that meets."""
    meet = have_common_point(a, b)
    assert [meet_by_elimination(x, y) for x, y in zip(a, b, strict=True)] == meet.tolist()
    assert np.array_equal(have_common_point(b, a), meet)
    large = [x.astype(object) * 3**40 for x in (a, b)]
    assert np.array_equal(have_common_point(*large), meet)
    through = crossings(a, b)
    assert np.array_equal(crossings(*large), through)
    assert np.array_equal(crossings(b, a), np.roll(through, 3, axis=1))
    assert not (through.any(axis=1) & ~meet).any()
    return float(meet.mean())


# Side 1 makes most triangles degenerate, and most pairs coplanar or touching.
@pytest.mark.parametrize("side", [1, 2, 3, 8, 4000])
def test_random_triangles_against_elimination(side: int) -> None:
    rng = np.random.default_rng([1, side])
    a, b = (rng.integers(-side, side + 1, (200, 3, 3)) for _ in range(2))
    assert 0.1 < check(a, b) < 0.9
    b[::2, :, 2] = a[::2, :, 2] = 0  # in one plane
    b[::4, 0] = a[::4, 1] = a[::4, 2]  # one is a segment, one corner in common
    assert check(a, b) > 0.1


@pytest.mark.parametrize("shapes", list(product(("triangle", "segment", "point"), repeat=2)), ids="-".join)
def test_segments_and_points(shapes: tuple[str, str]) -> None:
    rng = np.random.default_rng(2)
    pair = [rng.integers(-1, 2, (100, 3, 3)) for _ in shapes]
    for x, shape in zip(pair, shapes, strict=True):
        if shape == "segment":
            x[:, 2] = np.where(rng.random((100, 1)) < 0.5, x[:, 0], 2 * x[:, 1] - x[:, 0])
        if shape == "point":
            x[:, 1:] = x[:, :1]
    assert check(*pair) > 0.01


TRIANGLE = [[0, 0, 0], [8, 0, 0], [0, 8, 0]]


@pytest.mark.parametrize(
    ("other", "meets", "edges"),
    [
        ([[2, 2, -1], [2, 2, 1], [20, 2, 0]], True, 2),  # two edges pass through
        ([[2, 2, -1], [2, 2, 1], [1, 1, 2]], True, 2),
        ([[2, 2, 0], [2, 2, 1], [1, 1, 2]], True, 0),  # a corner touches the inside
        ([[1, 1, 0], [2, 2, 0], [1, 1, 2]], True, 0),  # an edge lies in the face
        ([[4, 4, -1], [4, 4, 1], [9, 9, 0]], True, 0),  # an edge touches an edge
        ([[0, 0, -1], [0, 0, 1], [-5, -5, 0]], True, 0),  # an edge touches a corner
        ([[8, 0, 0], [9, 0, 1], [9, 1, 0]], True, 0),  # a corner in common
        ([[0, 0, 0], [8, 0, 0], [0, -8, 3]], True, 0),  # an edge in common
        ([[1, 1, 0], [2, 1, 0], [1, 2, 0]], True, 0),  # inside, in one plane
        ([[4, 5, 0], [9, 9, 0], [5, 4, 0]], False, 0),  # beside it, in one plane
        ([[1, 1, 1], [2, 1, 1], [1, 2, 1]], False, 0),  # parallel
        ([[5, 4, -1], [5, 4, 1], [9, 9, 0]], False, 0),
    ],
)
def test_known_cases(other: list[list[int]], meets: bool, edges: int) -> None:
    for order in ([0, 1, 2], [1, 2, 0], [2, 1, 0]):
        a, b = np.array([TRIANGLE]), np.array([other])[:, order]
        assert check(a, b) == meets
        assert crossings(a, b).sum() == edges


def test_doubles_become_integers() -> None:
    x = np.array([[1.5, -0.0, 2.0**-60], [3e20, -1e-20, 5e-324]])
    whole = as_integers(x)
    unit = Fraction(x[0, 0]) / int(whole[0, 0])
    assert all(int(n) * unit == Fraction(v) for n, v in zip(whole.ravel(), x.ravel(), strict=True))
    assert (as_integers(np.zeros((2, 3))) == 0).all()


def test_int64_is_refused_where_it_could_overflow() -> None:
    a = np.full((1, 3, 3), intersection.BOUND + 1)
    with pytest.raises(ValueError, match="Python integers"):
        have_common_point(a, a)
    assert have_common_point(a.astype(object), a.astype(object)).all()


def test_meshes() -> None:
    """A square that stands in another one."""
    lying = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]])
    standing = np.array([[-1, 2, -2], [3, 2, -2], [3, 2, 2], [-1, 2, 2]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])  # edges: 01, 02, 03, 12, 23
    found = intersection.crossings_of_meshes(lying, faces, standing, faces)
    assert found == {(3, 1, 0), (3, 2, 1), (4, 1, 1), (4, 0, 3)}
    joined, both = np.concatenate([lying, standing]), np.concatenate([faces, faces + 4])
    assert intersection.crossings_within(joined, both) == {(3, 1, 2), (3, 2, 3), (3, 6, 1), (3, 8, 0)}
    # Edges from a common vertex are left out.
    fan = np.array([*TRIANGLE, [2, 2, -1], [2, 2, 1]])
    assert intersection.crossings_within(fan, np.array([[0, 1, 2], [0, 3, 4]])) == {(3, 5, 0)}


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, 2, 5, 50])
def test_many_triangles_against_elimination(side: int) -> None:
    rng = np.random.default_rng([3, side])
    check(*(rng.integers(-side, side + 1, (20000, 3, 3)) for _ in range(2)))
