"""Root isolation and signs at roots, against polynomials multiplied out from known factors."""

from __future__ import annotations

from fractions import Fraction
from functools import reduce

import numpy as np
import pytest

from . import polynomial
from .polynomial import Polynomial, roots_in_unit_interval, sign

HALF, THIRD, ZERO, ONE, TWO = (-1, 2), (-1, 3), (0, 1), (-1, 1), (-2, 1)
ROOT_HALF = (-1, 0, 2)  # 2 t^2 - 1: irrational, and another root outside
NONE = (1, 0, 1)


def product(*factors: Polynomial) -> Polynomial:
    return reduce(polynomial.mul, factors)


@pytest.mark.parametrize(
    ("factors", "expected"),
    [
        ([HALF], [0.5]),
        ([NONE], []),
        ([TWO], []),
        ([ZERO], [0.0]),
        ([ONE], [1.0]),
        ([ZERO, ONE, HALF], [0.0, 0.5, 1.0]),
        ([HALF, HALF, THIRD], [1 / 3, 0.5]),
        ([THIRD, THIRD, THIRD], [1 / 3]),
        ([ROOT_HALF, ROOT_HALF, NONE, THIRD], [1 / 3, 0.5**0.5]),
        ([(-1, 10**30), (-1, 10**30 + 1)], [1e-30, 1e-30]),
        ([(-(10**20), 10**20 + 1), ONE], [1.0, 1.0]),
    ],
)
def test_roots(factors: list[Polynomial], expected: list[float]) -> None:
    p = product(*factors)
    roots = roots_in_unit_interval(p)
    assert len(roots) == len(expected)
    for root, value in zip(roots, expected, strict=True):
        root.refine(200)
        assert root.upper - root.lower <= Fraction(1, 2**200)
        assert float(root.lower) == pytest.approx(value, abs=1e-15)
        assert root.sign_of(p) == 0
        for factor in factors:
            at = sum(c * value**k for k, c in enumerate(factor))
            if abs(at) > 1e-9:  # others may be roots of it
                assert root.sign_of(factor) == sign(round(1e20 * at))


def test_sign_at_a_shared_irrational_root_is_zero_and_next_to_it_is_not() -> None:
    root = roots_in_unit_interval(product(ROOT_HALF, THIRD))[1]
    assert root.sign_of(product(ROOT_HALF, (1, 5), NONE)) == 0
    # sqrt(1/2) - (sqrt(1/2) rounded down to 100 bits) is positive, and to the other side negative
    root.refine(110)
    floor = int(root.lower * 2**100)
    assert root.sign_of((-floor, 2**100)) == 1
    assert root.sign_of((-floor - 1, 2**100)) == -1


def test_random_products_have_the_roots_they_were_made_of() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        wanted = [Fraction(int(n), int(d)) for n, d in zip(rng.integers(-3, 9, 4), rng.integers(1, 9, 4), strict=True)]
        p = product(*[(-w.numerator, w.denominator) for w in wanted])
        inside = sorted({w for w in wanted if 0 <= w <= 1})
        roots = roots_in_unit_interval(p)
        assert len(roots) == len(inside)
        for root, w in zip(roots, inside, strict=True):
            assert root.lower <= w <= root.upper
            assert root.exact == (root.lower == w == root.upper)
            assert root.sign_of((-w.numerator, w.denominator)) == 0
            assert root.sign_of((1 - 1000 * w.numerator, 1000 * w.denominator)) == 1
