"""Recursive coordinate bisection (Berger & Bokhari 1987): planes divide space recursively into one part per rank, such
that the loads on both sides are proportional to the numbers of ranks. Hot spots of any size are divided. A rank stores
P - 1 planes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.partition.interface import Partition, Point, box_given

# A plane is searched in _BINS bins; the bin that contains it is subdivided, _ZOOMS times in all.
_BINS, _ZOOMS = 64, 4
# Cells per axis of a rank's part, used to find own bodies near ghosts.
_CELLS = 16
# Parts are neighbours if the gap between them is at most this fraction of their shortest edges. Planes in different
# branches of the tree differ slightly, so parts that nearly meet in an edge or a corner need not touch.
_NEAR = 1.0 / 8.0
# Maximum distance of a plane outside of the part that it divides, relative to the box's largest coordinate.
_SLACK = 1e-12


@dataclass(frozen=True, eq=False)
class Bisection(Partition):
    """Space divided by planes into one box per rank. Made by `Bisection.uniform`.

    All functions of points and boxes are monotone along every axis: points are compared with planes exactly.

    Attributes:
        lower, upper: (3,) corners of the space, in scene length units; what lies outside belongs to the nearest box.
        planes: (P - 1, 4) float64: axis, coordinate, and the children below and above: a later row, or rank r as
            -1 - r.
    """

    lower: Point
    upper: Point
    planes: Tensor

    @classmethod
    def uniform(cls, lower: Point, upper: Point, ranks: int, device: torch.device | str = "cpu") -> Bisection:
        """Parts of equal volume.

        Args:
            lower, upper: corners of the world's box, length units.
            ranks: number of parts.
            device: of the planes.

        Raises:
            ValueError, TypeError: naming the argument.

        Example:
            >>> partition = pgccd.distributed.Bisection.uniform((0, 0, 0), (8, 8, 8), ranks=5)
            >>> partition.owner_of(torch.tensor([[1.0, 7.0, 3.0]]))
        """
        low, high = box_given(lower, upper)
        if ranks < 1:
            raise ValueError(f"ranks: expected at least 1, got {ranks}")

        def in_proportion(level: Sequence[_Split]) -> list[float]:
            return [split.low + split.fraction * (split.high - split.low) for split in level]

        return cls(low, high, _bisect(low, high, [1.0] * ranks, in_proportion).to(device))

    @property
    def ranks(self) -> int:
        return len(self.planes) + 1

    def owner_of(self, points: Tensor) -> Tensor:
        at = torch.full((len(points),), 0 if len(self.planes) else -1, device=points.device)
        for _ in range(self._depth):
            plane = self.planes[at.clamp(min=0)]
            coordinate = points.gather(1, plane[:, :1].long())[:, 0]
            side = torch.where(coordinate < plane[:, 1], plane[:, 2], plane[:, 3]).long()
            at = torch.where(at >= 0, side, at)
        return -1 - at

    @functools.cached_property
    def _depth(self) -> int:
        """Depth of the tree of planes: each plane halves the number of ranks."""
        return (self.ranks - 1).bit_length()

    @functools.cached_property
    def boxes(self) -> list[tuple[list[float], list[float]]]:
        """The lower and upper corners of each rank's part, clipped to the world's box."""
        found: list[tuple[list[float], list[float]]] = [([], [])] * self.ranks
        planes = self.planes.tolist()
        todo = [(0 if planes else -1, list(self.lower), list(self.upper))]
        while todo:
            at, low, high = todo.pop()
            if at < 0:
                found[-1 - at] = low, high
                continue
            number, coordinate, below, above = planes[at]
            axis = int(number)
            todo.append((int(below), low, [*high[:axis], coordinate, *high[axis + 1 :]]))
            todo.append((int(above), [*low[:axis], coordinate, *low[axis + 1 :]], high))
        return found

    def neighbours(self, rank: int) -> list[int]:
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in zip(*self.boxes, strict=True))
        shortest = (high - low).amin(dim=1).clamp(min=0.0)
        # Bodies outside of the world belong to the parts at its boundary.
        low = torch.where(low <= torch.tensor(self.lower, dtype=torch.float64), -torch.inf, low)
        high = torch.where(high >= torch.tensor(self.upper, dtype=torch.float64), torch.inf, high)
        gap = torch.maximum(low - high[rank], low[rank] - high).amax(dim=1)
        near = gap <= _NEAR * torch.minimum(shortest, shortest[rank])
        return sorted({rank, *torch.nonzero(near)[:, 0].tolist()})

    def subdomain(self, rank: int, numbers: Tensor | None = None) -> ops.Subdomain:
        low, high = self.boxes[rank]
        per_length = [_CELLS / (b - a) if b > a else 0.0 for a, b in zip(low, high, strict=True)]
        # In a captured graph these cells are constants, while planes change. Any cells give the same pairs, since the
        # outermost extend to infinity.
        frame = [*low, *per_length, *([float(_CELLS)] * 3)]
        if numbers is None:
            return frame, self.planes, rank
        children = self.planes[:, 2:]
        of_ranks = numbers.to(children.device)[(-1.0 - children).clamp(min=0.0).long()]
        renamed = torch.where(children < 0.0, -1.0 - of_ranks, children)
        return frame, torch.cat([self.planes[:, :2], renamed], dim=1), int(numbers[rank])

    def with_planes(self, planes: Tensor) -> Bisection:
        """The same box, divided by other planes.

        Args:
            planes: (P - 1, 4) float64, as in `Bisection`.

        Raises:
            ValueError: they do not divide the box into one part per rank.
        """
        if planes.shape != self.planes.shape or planes.dtype != torch.float64:
            expected = f"({len(self.planes)}, 4) float64"
            raise ValueError(f"planes: expected {expected}, got {tuple(planes.shape)} {planes.dtype}")
        if not bool(torch.isfinite(planes).all()):
            raise ValueError("planes: expected finite numbers")
        # Rounding in the search may place a plane outside of its part.
        slack = _SLACK * max(abs(x) for corner in (self.lower, self.upper) for x in corner)
        coordinates = planes[:, 1].tolist()

        def as_given(level: Sequence[_Split]) -> list[float]:
            found = [coordinates.pop(0) for _ in level]
            for at, split in zip(found, level, strict=True):
                if not split.low - slack <= at <= split.high + slack:
                    raise ValueError(f"planes: {at} is outside of the part from {split.low} to {split.high}")
            return found

        # The coordinates determine the other columns.
        if not torch.equal(_bisect(self.lower, self.upper, [1.0] * self.ranks, as_given), planes.cpu()):
            raise ValueError(f"planes: expected a tree of {self.ranks} parts, each divided across its longest axis")
        return replace(self, planes=planes.to(self.planes.device))

    def rebalanced(self, comm: Comm, points: Tensor, weights: Tensor, shares: Sequence[float]) -> Bisection:
        """Planes that divide the load of all ranks in given shares, by four sums over the ranks per level.

        Args:
            comm: between the ranks.
            points: (K, 3) float64 positions of this rank's load.
            weights: (K,) int64 of the points.
            shares: relative share of each rank.
        """
        search = _PlaneSearch(comm, points, weights)
        planes = _bisect(self.lower, self.upper, shares, search.find)
        return replace(self, planes=planes.to(self.planes.device))


@dataclass(frozen=True)
class _Split:
    """A part to be divided."""

    axis: int
    low: float  #: bounds of the part along the axis
    high: float
    fraction: float  #: fraction of the load below the plane
    children: tuple[int, int]  #: indices of the splits in the next level, below and above; -1: a rank's part


@dataclass(frozen=True)
class _PartOfRanks:
    first: int
    end: int
    low: tuple[float, ...]
    high: tuple[float, ...]


def _bisect(
    lower: Point, upper: Point, shares: Sequence[float], find: Callable[[Sequence[_Split]], list[float]]
) -> Tensor:
    """The planes, level by level; `find` returns the coordinates of a level."""
    rows: list[list[float]] = []
    level = [_PartOfRanks(0, len(shares), lower, upper)] if len(shares) > 1 else []
    while level:
        middles = [(part.first + part.end) // 2 for part in level]
        inner = [(middle - part.first > 1, part.end - middle > 1) for part, middle in zip(level, middles, strict=True)]
        splits, count = [], 0
        for part, middle, is_inner in zip(level, middles, inner, strict=True):
            extent = [b - a for a, b in zip(part.low, part.high, strict=True)]
            axis = extent.index(max(extent))
            fraction = sum(shares[part.first : middle]) / sum(shares[part.first : part.end])
            children = []
            for side in is_inner:
                children.append(count if side else -1)
                count += side
            splits.append(_Split(axis, part.low[axis], part.high[axis], fraction, (children[0], children[1])))
        next_row = len(rows) + len(level)
        following = []
        for part, middle, split, at in zip(level, middles, splits, find(splits), strict=True):
            ranks = part.first, part.end - 1
            sides = [
                float(next_row + child if child >= 0 else -1 - rank)
                for child, rank in zip(split.children, ranks, strict=True)
            ]
            rows.append([float(split.axis), at, *sides])
            axis = split.axis
            halves = (
                _PartOfRanks(part.first, middle, part.low, (*part.high[:axis], at, *part.high[axis + 1 :])),
                _PartOfRanks(middle, part.end, (*part.low[:axis], at, *part.low[axis + 1 :]), part.high),
            )
            following += [half for half, child in zip(halves, split.children, strict=True) if child >= 0]
        level = following
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)


class _PlaneSearch:
    """Finds the planes that divide the load in given fractions: sums the load in bins between the bounds of a part over
    the ranks, and subdivides the bin that contains the plane.

    Args:
        comm: between the ranks.
        points, weights: as for `Bisection.rebalanced`.
    """

    def __init__(self, comm: Comm, points: Tensor, weights: Tensor) -> None:
        self._comm, self._points, self._weights = comm, points, weights
        # The split of the current level that contains each point; -1: none.
        self._split = torch.zeros(len(points), dtype=torch.int64, device=points.device)

    def find(self, level: Sequence[_Split]) -> list[float]:
        """The coordinates of the planes of a level, equal on all ranks."""
        device, count = self._points.device, len(level)
        inside = self._split >= 0
        split, points, weights = self._split[inside], self._points[inside], self._weights[inside]
        axis = torch.tensor([s.axis for s in level], device=device)
        low = torch.tensor([s.low for s in level], dtype=torch.float64, device=device)
        high = torch.tensor([s.high for s in level], dtype=torch.float64, device=device)
        coordinate = points.gather(1, axis[split][:, None])[:, 0]
        # Bodies outside of the world are clamped to its boundary.
        place = torch.minimum(torch.maximum(coordinate, low[split]), high[split])
        share = torch.tensor([s.fraction for s in level], dtype=torch.float64, device=device)
        below = torch.zeros(count, dtype=torch.int64, device=device)
        target: Tensor | None = None
        for _ in range(_ZOOMS):
            width = (high - low) / _BINS
            bins = ((place - low[split]) / width[split]).nan_to_num(0.0).floor().clamp(-1, _BINS).long()
            bins = torch.where((bins == _BINS) & (place <= high[split]), _BINS - 1, bins)
            counts = bins.new_zeros(count * _BINS)
            among = (bins >= 0) & (bins < _BINS)
            counts.index_add_(0, (split * _BINS + bins)[among], weights[among])
            load = self._comm.sum(counts).view(count, _BINS)
            if target is None:
                target = share * load.sum(dim=1)
            up_to = below[:, None] + load.cumsum(dim=1)
            chosen = (up_to < target[:, None]).sum(dim=1).clamp(max=_BINS - 1)
            below = torch.where(chosen > 0, up_to.gather(1, (chosen - 1).clamp(min=0)[:, None])[:, 0], below)
            low, high = low + chosen * width, low + (chosen + 1) * width
        is_empty = target == 0.0 if target is not None else below == 0
        even = torch.tensor([s.low + s.fraction * (s.high - s.low) for s in level], dtype=torch.float64, device=device)
        at = torch.where(is_empty, even, high)
        children = torch.tensor([s.children for s in level], device=device)
        self._split[inside] = children[split, (coordinate >= at[split]).long()]
        return at.tolist()
