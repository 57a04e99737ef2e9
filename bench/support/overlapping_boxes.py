"""All pairs of features with overlapping swept axis-aligned boxes, by sorting along one axis, in bounded chunks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# Pairs per chunk that overlap along the sorted axis.
_CHUNK = 4_000_000


@dataclass
class Boxes:
    """Boxes (n, 3) and (n, 3) of features given by their vertices (n, k)."""

    lower: np.ndarray
    upper: np.ndarray
    vertices: np.ndarray

    @classmethod
    def swept(cls, x_t0: np.ndarray, x_t1: np.ndarray, vertices: np.ndarray) -> Boxes:
        """Boxes around the features' vertices at both ends."""
        points = np.concatenate([x_t0[vertices], x_t1[vertices]], axis=1)
        return cls(points.min(axis=1), points.max(axis=1), vertices)

    def __len__(self) -> int:
        return len(self.lower)


def between(first: Boxes, second: Boxes) -> Iterator[np.ndarray]:
    """Pairs (p, 2) of rows of `first` and `second` with overlapping boxes (touching counts) and no common vertex."""
    axis = min(range(3), key=lambda axis: _count(first, second, axis))
    # If two intervals overlap, the lower end of one lies in the other.
    for a, b, swapped in ((first, second, False), (second, first, True)):
        order = np.argsort(b.lower[:, axis], kind="stable")
        ends = b.lower[order, axis]
        # Equal lower ends must be counted once.
        begin = np.searchsorted(ends, a.lower[:, axis], side="right" if swapped else "left")
        end = np.searchsorted(ends, a.upper[:, axis], side="right")
        for rows, positions in _expand(begin, np.maximum(end - begin, 0)):
            pairs = np.stack([rows, order[positions]], axis=1)
            yield _keep(first, second, pairs[:, ::-1] if swapped else pairs)


def within(boxes: Boxes) -> Iterator[np.ndarray]:
    """Pairs (p, 2), first < second, of overlapping boxes without a common vertex."""
    axis = min(range(3), key=lambda axis: _count(boxes, boxes, axis))
    order = np.argsort(boxes.lower[:, axis], kind="stable")
    ends = boxes.lower[order, axis]
    begin = np.arange(1, len(boxes) + 1)
    end = np.searchsorted(ends, boxes.upper[order, axis], side="right")
    for rows, positions in _expand(begin, np.maximum(end - begin, 0)):
        yield _keep(boxes, boxes, np.sort(np.stack([order[rows], order[positions]], axis=1), axis=1))


def _count(first: Boxes, second: Boxes, axis: int) -> int:
    lower, upper = np.sort(second.lower[:, axis]), np.sort(second.upper[:, axis])
    overlapping = np.searchsorted(lower, first.upper[:, axis], side="right")
    return int((overlapping - np.searchsorted(upper, first.lower[:, axis], side="left")).sum())


def _expand(begin: np.ndarray, count: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Row k paired with each index from begin[k] to begin[k] + count[k] (exclusive)."""
    total = np.concatenate([[0], np.cumsum(count)])
    first = 0
    while first < len(count):
        last = max(first + 1, int(np.searchsorted(total, total[first] + _CHUNK, side="right")) - 1)
        rows = np.repeat(np.arange(first, last), count[first:last])
        yield rows, np.arange(total[first], total[last]) - total[rows] + begin[rows]
        first = last


def _keep(first: Boxes, second: Boxes, pairs: np.ndarray) -> np.ndarray:
    for axis in range(3):
        i, j = pairs[:, 0], pairs[:, 1]
        apart = (first.lower[i, axis] > second.upper[j, axis]) | (second.lower[j, axis] > first.upper[i, axis])
        pairs = pairs[~apart]
    vertices_i, vertices_j = first.vertices[pairs[:, 0]], second.vertices[pairs[:, 1]]
    shared = (vertices_i[:, :, None] == vertices_j[:, None, :]).any(axis=(1, 2))
    return pairs[~shared]
