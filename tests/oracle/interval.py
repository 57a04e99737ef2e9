"""Interval arithmetic on float64 arrays, rounded outward.

IEEE 754 rounds + - * / and the square root correctly, so the next double below (above) a computed bound is below
(above) the exact one, whether it was rounded, underflowed or not. Overflow gives infinities, which stay valid bounds.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def down(x: np.ndarray) -> np.ndarray:
    """The next double below."""
    return np.nextafter(x, -np.inf)


def up(x: np.ndarray) -> np.ndarray:
    """The next double above."""
    return np.nextafter(x, np.inf)


class Interval:
    """Elementwise closed intervals [lo, hi]; every operation encloses the exact result of every choice of operands."""

    __slots__ = ("hi", "lo")
    __array_ufunc__ = None  # so that ndarray + Interval calls this class

    def __init__(self, lo: Any, hi: Any | None = None) -> None:
        self.lo = np.asarray(lo, dtype=np.float64)
        self.hi = self.lo if hi is None else np.asarray(hi, dtype=np.float64)

    @staticmethod
    def of(x: Any) -> Interval:
        """Intervals unchanged; anything else as exact doubles."""
        return x if isinstance(x, Interval) else Interval(x)

    @staticmethod
    def between(lo: np.ndarray, hi: np.ndarray) -> Interval:
        """As Interval(lo, hi), of float64 arrays, which are not converted: oracles make very many small ones."""
        made = object.__new__(Interval)
        made.lo, made.hi = lo, hi
        return made

    def __getitem__(self, key: Any) -> Interval:
        lo = self.lo[key]
        return Interval.between(lo, lo if self.hi is self.lo else self.hi[key])

    def __neg__(self) -> Interval:
        return Interval.between(-self.hi, -self.lo)

    def __add__(self, other: Any) -> Interval:
        o = Interval.of(other)
        return Interval.between(down(self.lo + o.lo), up(self.hi + o.hi))

    def __sub__(self, other: Any) -> Interval:
        o = Interval.of(other)
        return Interval.between(down(self.lo - o.hi), up(self.hi - o.lo))

    def __mul__(self, other: Any) -> Interval:
        o = Interval.of(other)
        first, last = self.lo * o.lo, self.hi * o.hi
        low, high = np.minimum(first, last), np.maximum(first, last)
        if o.hi is not o.lo and self.hi is not self.lo:
            first, last = self.lo * o.hi, self.hi * o.lo
            low, high = np.minimum(low, np.minimum(first, last)), np.maximum(high, np.maximum(first, last))
        return Interval.between(down(low), up(high))

    __radd__ = __add__
    __rmul__ = __mul__

    def __rsub__(self, other: Any) -> Interval:
        return Interval.of(other) - self

    def __truediv__(self, other: Any) -> Interval:
        """Division by positive intervals; others give (-inf, inf)."""
        o = Interval.of(other)
        with np.errstate(all="ignore"):
            quotients = [self.lo / o.lo, self.lo / o.hi, self.hi / o.lo, self.hi / o.hi]
            low, high = np.minimum.reduce(quotients), np.maximum.reduce(quotients)
        good = (o.lo > 0) & np.isfinite(low) & np.isfinite(high)
        return Interval(np.where(good, down(low), -np.inf), np.where(good, up(high), np.inf))

    def square(self) -> Interval:
        """x^2, never below zero."""
        small = np.where((self.lo <= 0) & (self.hi >= 0), 0.0, np.minimum(np.abs(self.lo), np.abs(self.hi)))
        large = np.maximum(np.abs(self.lo), np.abs(self.hi))
        return Interval.between(np.maximum(down(small * small), 0.0), up(large * large))

    def sqrt(self) -> Interval:
        """Square root of intervals that are non-negative except for rounding."""
        lo, hi = np.sqrt(np.maximum(self.lo, 0.0)), np.sqrt(np.maximum(self.hi, 0.0))
        return Interval(np.maximum(down(lo), 0.0), up(hi))

    def magnitude(self) -> np.ndarray:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    def middle(self) -> np.ndarray:
        """Some double in or next to the interval."""
        return 0.5 * self.lo + 0.5 * self.hi

    def sum(self, axis: int) -> Interval:
        """Sum along an axis, term by term."""
        total = self.take(0, axis)
        for i in range(1, self.lo.shape[axis]):
            total = total + self.take(i, axis)
        return total

    def replaced(self, where: np.ndarray, other: Interval) -> Interval:
        """`other` where the mask is set."""
        return Interval(np.where(where, other.lo, self.lo), np.where(where, other.hi, self.hi))

    def take(self, index: Any, axis: int) -> Interval:
        """numpy.take of both bounds."""
        return Interval(np.take(self.lo, index, axis), np.take(self.hi, index, axis))


def dot(a: Interval, b: Any) -> Interval:
    """a . b over the last axis of length 3."""
    return _sum_of_three(a * b)


def cross(a: Interval, b: Interval) -> Interval:
    """a x b over the last axis of length 3."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


def norm(a: Interval) -> Interval:
    """|a| over the last axis of length 3."""
    return _sum_of_three(a.square()).sqrt()


_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


def _sum_of_three(x: Interval) -> Interval:
    return x[..., 0] + x[..., 1] + x[..., 2]


def sinc_cosc(x: Interval) -> tuple[Interval, Interval]:
    """sin(x) / x and (1 - cos x) / x^2 of x >= 0.

    Taylor series at y = x / 2^k <= 2 with the first dropped term as the remainder (alternating, terms falling), then
    sinc(2 y) = sinc(y) cos(y), cos(2 y) = 2 cos(y)^2 - 1, and at last (1 - cos x) / x^2 = sinc(x / 2)^2 / 2.
    """
    with np.errstate(divide="ignore"):
        halvings = np.maximum(np.ceil(np.log2(x.hi)), 1.0)  # at least one, and y = x / 2^halvings is at most about 1
    y = Interval(np.maximum(x.lo, 0.0), x.hi) * np.ldexp(1.0, -halvings.astype(int))
    z = y.square()
    cos, sinc = _alternating(z)
    for done in range(1, int(np.max(halvings, initial=1.0))):
        more = halvings > done
        sinc, cos = sinc.replaced(more, sinc * cos), cos.replaced(more, cos.square() * 2.0 - 1.0)
    return sinc * cos, sinc.square() * 0.5


def _alternating(z: Interval) -> tuple[Interval, Interval]:
    # For odd = 0 and 1: sum over j of (-z)^j / (2 j + odd)!, 0 <= z <= 4, as a Horner scheme whose innermost factor
    # 1 - z / (...) (1 - ...) is cut after 14 terms, where the rest is between 0 and 1.
    odd = np.arange(2.0).reshape(2, *[1] * z.lo.ndim)
    result = Interval(np.zeros((2, *z.lo.shape)), np.ones((2, *z.lo.shape)))
    for j in range(14, 0, -1):
        factor = (2 * j + odd) * (2 * j + odd - 1)
        ratio = Interval.between(down(z.lo / factor), up(z.hi / factor))
        result = 1.0 - ratio * result
    return result[0], result[1]
