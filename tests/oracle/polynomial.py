"""Exact univariate polynomials over the integers: isolation of the real roots in [0, 1] and signs at those roots.

A polynomial is a tuple of Python integers, lowest power first, without trailing zeros; ``()`` is zero. A root is either
an exact dyadic rational or an open dyadic interval that holds exactly one, simple, root (Descartes' rule in the
Bernstein basis; Collins & Akritas 1976, Mourrain, Rouillier & Roy 2005). There is no rounding.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from math import comb, gcd, lcm

Polynomial = tuple[int, ...]


def sign(x: int) -> int:
    """-1, 0 or 1."""
    return (x > 0) - (x < 0)


def trim(coefficients: list[int]) -> Polynomial:
    """Drop leading zeros (highest powers)."""
    while coefficients and not coefficients[-1]:
        coefficients.pop()
    return tuple(coefficients)


def add(p: Polynomial, q: Polynomial) -> Polynomial:
    """p + q."""
    if len(p) < len(q):
        p, q = q, p
    return trim([a + b for a, b in zip(p, q, strict=False)] + list(p[len(q) :]))


def sub(p: Polynomial, q: Polynomial) -> Polynomial:
    """p - q."""
    return add(p, tuple(-c for c in q))


def mul(p: Polynomial, q: Polynomial) -> Polynomial:
    """p q."""
    if not p or not q:
        return ()
    product = [0] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        if a:
            for j, b in enumerate(q):
                product[i + j] += a * b
    return tuple(product)  # leading coefficients are not zero, so neither is their product


def primitive(p: Polynomial) -> Polynomial:
    """p divided by the (positive) gcd of its coefficients."""
    content = gcd(*p)
    return tuple(c // content for c in p) if content > 1 else p


def derivative(p: Polynomial) -> Polynomial:
    """dp/dt."""
    return tuple(i * c for i, c in enumerate(p))[1:]


def pseudo_divide(p: Polynomial, q: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Quotient and remainder of (some non-zero multiple of p) by q."""
    remainder, quotient = list(p), [0] * max(len(p) - len(q) + 1, 0)
    lead = q[-1]
    for shift in range(len(p) - len(q), -1, -1):
        top = remainder[shift + len(q) - 1]
        remainder = [lead * c for c in remainder]
        quotient = [lead * c for c in quotient]
        quotient[shift] += top
        for i, c in enumerate(q):
            remainder[shift + i] -= top * c
    return trim(quotient), trim(remainder)


def greatest_common_divisor(p: Polynomial, q: Polynomial) -> Polynomial:
    """gcd over the rationals, as a primitive integer polynomial (sign arbitrary); a constant is returned as (1,)."""
    p, q = primitive(p), primitive(q)
    while q:
        p, q = q, primitive(pseudo_divide(p, q)[1])
    return (1,) if len(p) == 1 else p


def squarefree(p: Polynomial) -> Polynomial:
    """A polynomial with the same roots as p, all simple. p must not be zero."""
    if len(p) <= 2:
        return primitive(p)
    common = greatest_common_divisor(p, derivative(p))
    return primitive(p) if len(common) == 1 else primitive(pseudo_divide(p, common)[0])


def scaled_value(p: Polynomial, k: int, bits: int) -> int:
    """p(k / 2^bits) times a positive power of two."""
    result, shift = 0, 0
    for c in reversed(p):
        result = result * k + (c << shift)
        shift += bits
    return result


def restrict(p: Polynomial, k: int, bits: int) -> list[int]:
    """Coefficients in s of 2^(bits degree) p((k + s) / 2^bits)."""
    degree = len(p) - 1
    q = [c << (bits * (degree - i)) for i, c in enumerate(p)]
    for first in range(degree):  # Taylor shift by k
        for i in range(degree - 1, first - 1, -1):
            q[i] += k * q[i + 1]
    return q


@lru_cache(maxsize=64)
def _bernstein_weights(degree: int) -> list[list[int]]:
    # b_j = sum_i C(j, i) / C(degree, i) a_i, times the least common multiple of the denominators
    scale = lcm(*(comb(degree, i) for i in range(degree + 1)))
    return [[scale * comb(j, i) // comb(degree, i) for i in range(j + 1)] for j in range(degree + 1)]


def bernstein(coefficients: Polynomial | list[int]) -> list[int]:
    """Bernstein coefficients on [0, 1], all times one positive integer."""
    rows = _bernstein_weights(len(coefficients) - 1)
    return [sum(w * a for w, a in zip(row, coefficients, strict=False)) for row in rows]


def variations(coefficients: list[int]) -> int:
    """Sign changes, zeros left out: the roots in the open interval, plus an even number (Descartes)."""
    count, last = 0, 0
    for c in coefficients:
        if c:
            if (c < 0) != (last < 0) and last:
                count += 1
            last = c
    return count


class Root:
    """A simple root of a squarefree polynomial: k / 2^bits if ``exact``, else the only one in (k, k + 1) / 2^bits."""

    __slots__ = ("bits", "exact", "k", "polynomial", "sign_left")

    def __init__(self, polynomial: Polynomial, k: int, bits: int, exact: bool, sign_left: int = 0) -> None:
        self.polynomial, self.k, self.bits, self.exact = polynomial, k, bits, exact
        self.sign_left = sign_left  # of the polynomial between the lower end and the root

    @property
    def lower(self) -> Fraction:
        """Lower bound of the root."""
        return Fraction(self.k, 1 << self.bits)

    @property
    def upper(self) -> Fraction:
        """Upper bound of the root."""
        return Fraction(self.k + (not self.exact), 1 << self.bits)

    def refine(self, bits: int) -> None:
        """Bisect until the interval is no wider than 2^-bits."""
        while not self.exact and self.bits < bits:
            middle = 2 * self.k + 1
            at = sign(scaled_value(self.polynomial, middle, self.bits + 1))
            self.bits += 1
            self.k = middle if at == self.sign_left or at == 0 else 2 * self.k
            self.exact = at == 0

    def sign_of(self, p: Polynomial) -> int:
        """Exact sign of p at this root."""
        if len(p) <= 1:
            return sign(p[0]) if p else 0
        checked = False
        while not self.exact:
            a = restrict(p, self.k, self.bits)  # p = sum a_i s^i with 0 < s < 1
            if a[0] + sum(c for c in a[1:] if c < 0) > 0:
                return 1
            if a[0] + sum(c for c in a[1:] if c > 0) < 0:
                return -1
            if self.bits >= 24 and not checked:
                # p vanishes here iff gcd(p, polynomial) does: it divides a squarefree polynomial with no other root in
                # the interval, so it has one simple root or none there, which the parity of the variations
                # distinguishes.
                common = greatest_common_divisor(self.polynomial, p)
                if len(common) > 1 and variations(bernstein(restrict(common, self.k, self.bits))) % 2:
                    return 0
                checked = True
            self.refine(self.bits + 8)
        return sign(scaled_value(p, self.k, self.bits))


def _split(b: list[int]) -> tuple[list[int], list[int]]:
    # de Casteljau at 1/2 without division: both halves are times 2^degree
    degree, left, right = len(b) - 1, [], []
    for level in range(degree + 1):
        left.append(b[0] << (degree - level))
        right.append(b[-1] << (degree - level))
        b = [x + y for x, y in pairwise(b)]
    return left, right[::-1]


def roots_in_unit_interval(p: Polynomial) -> list[Root]:
    """All real roots of p in [0, 1], ascending, each once. p must not be zero."""
    b = bernstein(p)
    if all(c > 0 for c in b) or all(c < 0 for c in b):
        return []
    p = squarefree(p)
    b = bernstein(p)
    roots: list[Root] = [Root(p, 0, 0, True)] if not b[0] else []

    def visit(b: list[int], k: int, bits: int) -> None:
        count = variations(b)
        if count == 1:
            roots.append(Root(p, k, bits, False, sign(next(c for c in b if c))))
        elif count > 1:
            left, right = _split(b)
            visit(left, 2 * k, bits + 1)
            if not right[0]:
                roots.append(Root(p, 2 * k + 1, bits + 1, True))
            visit(right, 2 * k + 1, bits + 1)

    visit(b, 0, 0)
    if len(p) > 1 and not b[-1]:
        roots.append(Root(p, 1, 0, True))
    return roots
