"""The interface of partitions of space: ownership as pure functions of tensors."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import cast

from torch import Tensor

from pgccd import arguments, ops

Triple = tuple[int, int, int]
Point = tuple[float, float, float]


# The smallest extent of a box: numbers of cells per length are finite.
_SHORTEST = 1e-150


def box_given(lower: Point, upper: Point) -> tuple[Point, Point]:
    """The corners of a box as plain numbers.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    for name, corner in (("lower", lower), ("upper", upper)):
        if not hasattr(corner, "__len__") or isinstance(corner, str) or getattr(corner, "shape", (3,)) != (3,):
            raise TypeError(f"{name}: expected three finite numbers, got {arguments.describe(corner)}")
        if len(corner) != 3 or not all(math.isfinite(arguments.number(x, name)) for x in corner):
            raise ValueError(f"{name}: expected three finite numbers, got {corner}")
    low, high = (cast(Point, tuple(float(x) for x in corner)) for corner in (lower, upper))
    if not all(_SHORTEST <= b - a < math.inf for a, b in zip(low, high, strict=True)):
        expected = f"a box with volume above {tuple(lower)}, 1e-150 long or more along each axis"
        raise ValueError(f"upper: expected {expected}, got {tuple(upper)}")
    return low, high


class Partition(ABC):
    """Assigns every point of space to a rank; the same on all ranks.

    Attributes:
        lower, upper: corners of the world's box, length units.
    """

    lower: Point
    upper: Point

    @property
    @abstractmethod
    def ranks(self) -> int:
        """Number of ranks."""

    @abstractmethod
    def owner_of(self, points: Tensor) -> Tensor:
        """(K,) int64: the rank that owns each of the points (K, 3)."""

    @abstractmethod
    def neighbours(self, rank: int) -> list[int]:
        """The ranks whose parts are near a rank's part, and itself, ascending; a symmetric relation. Bodies may reach
        further: see `Decomposition`.
        """

    @abstractmethod
    def subdomain(self, rank: int, numbers: Tensor | None = None) -> ops.Subdomain:
        """A rank's part, as the operators expect it.

        Args:
            rank: whose part.
            numbers: (ranks,) int64: the numbers by which the operators name ranks. Default: the ranks.
        """
