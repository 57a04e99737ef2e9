"""The two-level uniform decomposition (Du, Liu & Suzumura 2017, 4.1) as pure functions of tensors.

The world's box is cut into one subspace a rank, each subspace into cells. A table, the same on every rank, says who
owns a cell: at first the rank of its subspace, later whatever balancing decides. Cells at the border of the box extend
to infinity, so that a body that leaves the box is never lost.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

Triple = tuple[int, int, int]
Point = tuple[float, float, float]

# Rows of (body, cell) made at a time.
_BLOCK_ROWS = 1 << 24


def factorise(ranks: int, extent: Point, axes: int = 3) -> Triple:
    """Subspaces along x, y and z: the factorisation whose subspaces have the least surface.

    Args:
        ranks: their number, the product of the three.
        extent: lengths of the box.
        axes: how many axes may be cut: 3; 2 (x and y); or 1 (slabs across the longest axis).

    Example:
        >>> pgccd.distributed.factorise(8, (1.0, 1.0, 1.0))
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
        # Of (to rounding) equal ones, that with the fewest cuts across z, along which cells are not cut any further.
        return float(f"{x * y + y * z + z * x:.9g}"), counts[2], counts[1]

    divisors = [count for count in range(1, ranks + 1) if ranks % count == 0]
    choices = [(x, y, ranks // (x * y)) for x, y in itertools.product(divisors, divisors) if ranks % (x * y) == 0]
    return min((counts for counts in choices if axes == 3 or counts[2] == 1), key=badness)


@dataclass(frozen=True, eq=False)
class Partition:
    """Which rank owns which part of space.

    Make one with `Partition.uniform`. All functions of points and boxes are monotone along every axis, rounding
    included: the cell of a point in a box lies between the cells of its corners.
    """

    lower: Point  #: of the world's box, length units
    upper: Point
    subspaces: Triple  #: along x, y and z; their product is the number of ranks
    cells: Triple  #: of each subspace
    owner: Tensor  #: (cell_count,) int64: the rank of each cell; x varies slowest, z fastest

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
    ) -> Partition:
        """Every cell owned by the rank of its subspace.

        Args:
            lower, upper: corners of the world's box, length units.
            ranks: number of subspaces.
            axes: see `factorise`.
            cells: of each subspace; m stands for (m, m, 1), the paper's m x m cells in X-Y.
            device: where the table lives.

        Raises:
            ValueError: naming the argument.

        Example:
            >>> partition = pgccd.distributed.Partition.uniform((0, 0, 0), (8, 8, 8), ranks=4)
            >>> partition.owner_of(torch.tensor([[1.0, 7.0, 3.0]]))
        """
        for name, corner in (("lower", lower), ("upper", upper)):
            if len(corner) != 3 or not all(math.isfinite(x) for x in corner):
                raise ValueError(f"{name}: expected three finite numbers, got {corner}")
        extent = cast(Point, tuple(float(high) - float(low) for low, high in zip(lower, upper, strict=True)))
        if not all(0.0 < length < math.inf for length in extent):
            raise ValueError(f"upper: expected a box with volume above {tuple(lower)}, got {tuple(upper)}")
        each = cast(Triple, (cells, cells, 1) if isinstance(cells, int) else tuple(cells))
        if len(each) != 3 or not all(isinstance(count, int) and 1 <= count <= 2**20 for count in each):
            raise ValueError(f"cells: expected integers in [1, 2^20], got {cells}")
        subspaces = factorise(ranks, extent, axes)
        shape = [count * parts for count, parts in zip(each, subspaces, strict=True)]
        if math.prod(shape) > 2**31:
            raise ValueError(f"cells: {math.prod(shape)} cells in all; expected at most 2^31")
        x, y, z = (torch.arange(size, device=device) // part for size, part in zip(shape, each, strict=True))
        owner = (x[:, None, None] * subspaces[1] + y[:, None]) * subspaces[2] + z
        low, high = (cast(Point, tuple(float(x) for x in corner)) for corner in (lower, upper))
        return cls(low, high, subspaces, each, owner.flatten())

    @property
    def ranks(self) -> int:
        return math.prod(self.subspaces)

    @property
    def grid(self) -> Triple:
        """Cells of the whole box along x, y and z."""
        return cast(Triple, tuple(a * b for a, b in zip(self.subspaces, self.cells, strict=True)))

    @property
    def cell_count(self) -> int:
        return math.prod(self.grid)

    @property
    def cell_size(self) -> Point:
        return cast(Point, tuple((b - a) / n for a, b, n in zip(self.lower, self.upper, self.grid, strict=True)))

    def with_owner(self, owner: Tensor) -> Partition:
        """The same cells in other hands.

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
        """(K, 3) int64: the cell along each axis that holds each of the points (K, 3)."""
        lower, per_length, last = self._frame
        return torch.minimum(((points - lower) * per_length).floor().clamp_(min=0.0), last).long()

    @functools.cached_property
    def _frame(self) -> tuple[Tensor, Tensor, Tensor]:
        """Lower corner, cells a length unit, and last cell, on the table's device."""
        lower, size, count = torch.tensor(
            [self.lower, self.cell_size, self.grid], dtype=torch.float64, device=self.owner.device
        )
        return lower, 1.0 / size, count - 1.0

    @functools.lru_cache(maxsize=1)  # noqa: B019  (asked for by one rank, its own, once a step)
    def foreign(self, rank: int) -> MarkedCells:
        """The cells that others than `rank` own."""
        return MarkedCells(self, self.owner != rank)

    def index(self, coordinates: Tensor) -> Tensor:
        """(K,) int64 positions in the table of cells (K, 3)."""
        x, y, z = coordinates.unbind(dim=-1)
        return (x * self.grid[1] + y) * self.grid[2] + z

    def cell_of(self, points: Tensor) -> Tensor:
        """(K,) int64: the cell of each of the points (K, 3)."""
        return self.index(self.coordinates(points))

    def owner_of(self, points: Tensor) -> Tensor:
        """(K,) int64: the rank that owns the cell of each of the points (K, 3)."""
        return self.owner[self.cell_of(points)]

    def reached(self, first: Tensor, last: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Every cell that boxes reach, in pieces of bounded size.

        Args:
            first, last: (K, 3) `coordinates` of the boxes' corners.

        Yields:
            box (R,) int64 and cell (R,) int64: box rows ascending, each of their cells once.
        """
        extent = last - first + 1
        count = extent.prod(dim=1)
        end = count.cumsum(0)
        begin_row, row_count = 0, first.shape[0]
        while begin_row < row_count:
            before = int(end[begin_row - 1]) if begin_row else 0
            end_row = max(begin_row + 1, int(torch.searchsorted(end, before + _BLOCK_ROWS, right=True)))
            rows = slice(begin_row, end_row)
            box = torch.repeat_interleave(torch.arange(begin_row, end_row, device=first.device), count[rows])
            within = torch.arange(len(box), device=first.device) - (end[box] - count[box] - before)
            _, ny, nz = extent[box].unbind(dim=1)
            offset = torch.stack([within // (ny * nz), within // nz % ny, within % nz], dim=1)
            yield box, self.index(first[box] + offset)
            begin_row = end_row


class MarkedCells:
    """A set of cells that can be asked in constant time how many of them a box of cells holds (a summed-area table).

    Args:
        partition: whose cells.
        marked: (cell_count,) bool.
    """

    def __init__(self, partition: Partition, marked: Tensor) -> None:
        sums = marked.view(partition.grid).long()
        for axis in range(3):
            sums = sums.cumsum(axis)
        self._sums = torch.nn.functional.pad(sums, (1, 0, 1, 0, 1, 0))

    def count(self, first: Tensor, last: Tensor) -> Tensor:
        """(K,) int64: marked cells between the cells first and last (K, 3), both included."""
        total = torch.zeros(first.shape[0], dtype=torch.int64, device=first.device)
        for corner in itertools.product((0, 1), repeat=3):
            at = [(last[:, axis] + 1) if high else first[:, axis] for axis, high in enumerate(corner)]
            total += (-1) ** (3 - sum(corner)) * self._sums[at[0], at[1], at[2]]
        return total


def ranks_reached(partition: Partition, first: Tensor, last: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """The other ranks that own any cell a box reaches.

    Args:
        first, last: (K, 3) `coordinates` of the boxes' corners.
        rank: left out.

    Returns:
        box (R,) and rank (R,) int64, sorted, no two rows alike.

    Example:
        >>> body, destination = ranks_reached(partition, first, last, comm.rank)
    """
    # Most boxes lie in one cell, and that is the rank's own.
    unsure = (first != last).any(dim=1) | (partition.owner[partition.index(first)] != rank)
    rows = torch.nonzero(unsure)[:, 0]
    crossing = rows[partition.foreign(rank).count(first[rows], last[rows]) > 0]
    found = []
    for box, cell in partition.reached(first[crossing], last[crossing]):
        owner = partition.owner[cell]
        found.append(torch.unique((crossing[box] * partition.ranks + owner)[owner != rank]))
    key = torch.cat(found) if found else crossing
    return key // partition.ranks, key % partition.ranks
