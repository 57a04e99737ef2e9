"""The two-level uniform decomposition of Du, Liu & Suzumura 2017, 4.1.

The world's box is cut into one subdomain per rank, each subdomain into cells. A table, the same on every rank, holds
the owner of each cell: at first the rank of its subdomain, later the one chosen by load balancing.

Cells at the boundary of the box extend to infinity, so a body that leaves the box still has an owner.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.distributed.partition.interface import Partition, Point, Triple, box_given


def factorise(ranks: int, extent: Point, axes: int = 3) -> Triple:
    """Subdomains along x, y and z: the factorisation with the smallest surface of a subdomain.

    Args:
        ranks: their number, the product of the three.
        extent: lengths of the box.
        axes: how many axes may be cut: 3; 2 (x and y); or 1 (slabs across the longest axis).

    Example:
        >>> factorise(8, (1.0, 1.0, 1.0))
        (2, 2, 2)
    """
    if ranks < 1:
        raise ValueError(f"ranks: expected at least 1, got {ranks}")
    if axes not in (1, 2, 3):
        raise ValueError(f"axes: expected 1, 2 or 3, got {axes}")
    if axes == 1:
        longest = max(range(3), key=lambda axis: extent[axis])
        return cast(Triple, tuple(ranks if axis == longest else 1 for axis in range(3)))

    def badness(counts: Triple) -> tuple[float, int, int]:
        x, y, z = (length / count for length, count in zip(extent, counts, strict=True))
        # Ties (to rounding) go to the fewest cuts across z, along which subdomains have one cell by default.
        return float(f"{x * y + y * z + z * x:.9g}"), counts[2], counts[1]

    divisors = [count for count in range(1, ranks + 1) if ranks % count == 0]
    choices = [(x, y, ranks // (x * y)) for x, y in itertools.product(divisors, divisors) if ranks % (x * y) == 0]
    return min((counts for counts in choices if axes == 3 or counts[2] == 1), key=badness)


def check_cells(axes: int, cells: int | Triple) -> Triple:
    """The number of cells along x, y and z of each subdomain, of the arguments of `Cells.uniform`.

    Raises:
        TypeError, ValueError: naming the argument.
    """
    expected = "1, 2 or 3"
    if arguments.integer(axes, "axes", 1, expected) > 3:
        raise ValueError(f"axes: expected {expected}, got {axes}")
    expected = "integers in [1, 2^20]"
    if not isinstance(cells, (int, tuple, list)):
        raise TypeError(f"cells: expected {expected}, got {arguments.describe(cells)}")
    each = cast(Triple, (cells, cells, 1) if isinstance(cells, int) else tuple(cells))
    if len(each) != 3 or not all(isinstance(count, int) and 1 <= count <= 2**20 for count in each):
        raise ValueError(f"cells: expected {expected}, got {cells}")
    return each


@dataclass(frozen=True, eq=False)
class Cells(Partition):
    """Space in equal cells, with a table of their owners.

    Made by `Cells.uniform`. All functions of points and boxes are monotone along every axis, rounding included: the
    cell of a point in a box lies between the cells of its corners.

    Attributes:
        lower, upper: (3,) corners of the space, in scene length units; what lies outside belongs to the nearest cell.
        subdomains: number along x, y and z; the product is the number of ranks.
        cells: number in each subdomain, along x, y and z.
        owner: (cell_count,) int64: the rank of each cell; x varies slowest, z fastest.
    """

    lower: Point
    upper: Point
    subdomains: Triple
    cells: Triple
    owner: Tensor

    @classmethod
    def uniform(
        cls,
        lower: Point,
        upper: Point,
        ranks: int,
        *,
        axes: int = 3,
        cells: int | Triple = 16,
        device: torch.device | str = "cpu",
    ) -> Cells:
        """Every cell owned by the rank of its subdomain.

        Args:
            lower, upper: corners of the world's box, length units.
            ranks: number of subdomains.
            axes: see `factorise`.
            cells: number in each subdomain; m means (m, m, 1), the paper's m x m cells in X-Y.
            device: of the table.

        Raises:
            ValueError: naming the argument.

        Example:
            >>> partition = pgccd.distributed.Cells.uniform((0, 0, 0), (8, 8, 8), ranks=4)
            >>> partition.owner_of(torch.tensor([[1.0, 7.0, 3.0]]))
        """
        low, high = box_given(lower, upper)
        extent = cast(Point, tuple(b - a for a, b in zip(low, high, strict=True)))
        each = check_cells(axes, cells)
        subdomains = factorise(ranks, extent, axes)
        shape = [count * parts for count, parts in zip(each, subdomains, strict=True)]
        if math.prod(shape) > 2**31:
            raise ValueError(f"cells: {math.prod(shape)} cells in all; expected at most 2^31")
        x, y, z = (torch.arange(size, device=device) // part for size, part in zip(shape, each, strict=True))
        owner = (x[:, None, None] * subdomains[1] + y[:, None]) * subdomains[2] + z
        return cls(low, high, subdomains, each, owner.flatten())

    @property
    def ranks(self) -> int:
        return math.prod(self.subdomains)

    @property
    def grid(self) -> Triple:
        """Cells of the whole box along x, y and z."""
        return cast(Triple, tuple(a * b for a, b in zip(self.subdomains, self.cells, strict=True)))

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return math.prod(self.grid)

    @property
    def cell_size(self) -> Point:
        """Size of a cell along x, y and z, length units."""
        return cast(Point, tuple((b - a) / n for a, b, n in zip(self.lower, self.upper, self.grid, strict=True)))

    def with_owner(self, owner: Tensor) -> Cells:
        """The same cells with other owners.

        Args:
            owner: (cell_count,) int64: the rank of each cell.

        Raises:
            ValueError: if `owner` does not name a rank for every cell.
        """
        if owner.shape != self.owner.shape or owner.dtype != torch.int64:
            raise ValueError(f"owner: expected ({self.cell_count},) int64, got {tuple(owner.shape)} {owner.dtype}")
        low, high = (int(x) for x in torch.aminmax(owner))
        if low < 0 or high >= self.ranks:
            raise ValueError(f"owner: values in [{low}, {high}], but there are {self.ranks} ranks")
        return replace(self, owner=owner.to(self.owner.device))

    def coordinates(self, points: Tensor) -> Tensor:
        """(K, 3) int64: the indices of the cell that contains each of the points (K, 3)."""
        lower, per_length, last = self._frame
        return torch.minimum(((points - lower) * per_length).floor().clamp_(min=0.0), last).long()

    @functools.cached_property
    def _frame(self) -> tuple[Tensor, Tensor, Tensor]:
        """Lower corner, cells per length unit, and index of the last cell, on the table's device."""
        lower, size, count = torch.tensor(
            [self.lower, self.cell_size, self.grid], dtype=torch.float64, device=self.owner.device
        )
        return lower, 1.0 / size, count - 1.0

    @functools.cached_property
    def frame(self) -> list[float]:
        """The grid for the operators: lower corner, cells per length unit, number of cells; each along x, y, z."""
        return [*self.lower, *(1.0 / size for size in self.cell_size), *map(float, self.grid)]

    def neighbours(self, rank: int) -> list[int]:
        cells = torch.nonzero(self.owner == rank)[:, 0]
        at = torch.stack(torch.unravel_index(cells, self.grid), dim=1)[:, None]
        steps = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3).to(at.device)
        last = torch.tensor(self.grid, device=at.device) - 1
        beside = self.index(torch.minimum((at + steps).clamp(min=0), last))
        return sorted({rank, *torch.unique(self.owner[beside]).tolist()})

    def subdomain(self, rank: int, numbers: Tensor | None = None) -> ops.Subdomain:
        if numbers is None:
            return self.frame, self.owner, rank
        return self.frame, numbers.to(self.owner.device)[self.owner], int(numbers[rank])

    def index(self, coordinates: Tensor) -> Tensor:
        """(K,) int64 positions in the table of cells, given by their `coordinates` (K, 3) int64."""
        x, y, z = coordinates.unbind(dim=-1)
        return (x * self.grid[1] + y) * self.grid[2] + z

    def cell_of(self, points: Tensor) -> Tensor:
        """(K,) int64: the cell of each of the points (K, 3)."""
        return self.index(self.coordinates(points))

    def owner_of(self, points: Tensor) -> Tensor:
        return self.owner[self.cell_of(points)]
