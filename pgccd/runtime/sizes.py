"""Fixed capacities of a detection step that does not synchronise with the host."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Never

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pgccd import arguments

# Bytes of GPU memory per unit of capacity, over all buffers of the operators.
_BYTES = {
    "pairs": 408,
    "overlaps": 8,
    "poses": 96,
    "tasks": 32,
    "leaf_pairs": 48,
    "candidates": 16,
    "open": 64,
    "contacts": 102,
}
# Added to every capacity, so that small scenes rarely overflow when they change.
_SMALLEST = 4096
#: Rows have 32-bit numbers.
MOST_ROWS = 2**31 - 1
_EXACT = -1  # number of contacts that stands for "as many as found"


class Capacity:
    """Buffer sizes for one step of `detect`: of the result and of all intermediate lists. Made by `of`, or taken from
    an earlier step (`Stats.needed`, `CapacityError.larger`).

    On a CPU only pairs and contacts can overflow; the rest is scratch memory of a GPU.

    Example:
        >>> capacity = pgccd.detect(scene, motion).stats.needed.times(1.5)
        >>> hits = pgccd.detect(scene, motion, capacity=capacity)
    """

    def __init__(self, *given: Never, **named: Never) -> None:
        raise TypeError("Capacity: make it by Capacity.of(body_count), or take it from Stats.needed")

    @classmethod
    def of(cls, body_count: int, pair_count: int | None = None, self_vertex_count: int = 0) -> Capacity:
        """A capacity for a first step: nearly twice what the nanorobot simulation and folded cloth need.

        Args:
            body_count: bodies of the scene.
            pair_count: number of body pairs, if they are given.
            self_vertex_count: number of vertices of bodies tested against themselves.

        Raises:
            TypeError, ValueError: naming the argument.

        Example:
            >>> capacity = pgccd.Capacity.of(scene.body_count)
        """
        arguments.integer(body_count, "body_count", 0, "a number of bodies >= 0")
        arguments.integer(self_vertex_count, "self_vertex_count", 0, "a number of vertices >= 0")
        if pair_count is not None:
            arguments.integer(pair_count, "pair_count", 0, "a number of pairs >= 0")
        pairs = 5 * body_count // 4 if pair_count is None else pair_count
        return BufferSizes(
            pairs=pairs,
            contacts=pairs // 2 + 4 * self_vertex_count,
            overlaps=3 * body_count if pair_count is None else 0,
            poses=pairs,
            tasks=pairs + 4 * self_vertex_count,
            leaf_pairs=12 * pairs + 12 * self_vertex_count,
            candidates=8 * pairs + 20 * self_vertex_count,
            open=3 * pairs + 8 * self_vertex_count,
            launches=12 if self_vertex_count else 3,  # most of the work is in a few parts of such a body
        ).times(1.0)

    def times(self, factor: float) -> Capacity:
        """This capacity, each part at least `factor` times as large, plus a minimum.

        Raises:
            TypeError, ValueError: `factor` is not a finite number >= 0.
        """
        return sizes_of(self).times(factor)


@dataclass(frozen=True, repr=False)
class BufferSizes(Capacity):
    """A capacity with its parts, for stages."""

    pairs: int  #: body pairs of the PCS
    contacts: int  #: rows of the result
    overlaps: int = 0  #: body pairs whose boxes overlap
    poses: int = 0  #: poses at the ends of time segments, of the body pairs that have several
    tasks: int = 0  #: node pairs with which a launch of the descent starts: roots, or what the one before leaves
    leaf_pairs: int = 0  #: pairs of leaves
    candidates: int = 0  #: feature pairs
    open: int = 0  #: feature pairs left by quick rejection
    launches: int = 3  #: traversal launches after the first
    long_rows: bool = False  #: whether one body may have more than 32 partners of larger index
    #: whether a pair of bodies may have very many candidates: a few of its leaves are then searched first, and the time
    #: of a step is divided further for bodies that turn fast
    crowded: bool = False

    def __post_init__(self) -> None:
        for name in _NAMES:
            number = getattr(self, name)
            if name in ("long_rows", "crowded"):
                arguments.flag(number, name)
            elif type(number) is not int or number < 0:  # the rare case
                arguments.integer(number, name, _EXACT if name == "contacts" else 0, "a number of rows >= 0")

    @classmethod
    def _of_checked(cls, **parts: Any) -> BufferSizes:
        """A capacity of valid parts, without checks: each call of `detect` makes one."""
        made = object.__new__(cls)
        made.__dict__.update(parts)
        return made

    def times(self, factor: float) -> BufferSizes:
        factor = arguments.length(factor, "factor")
        scaled: dict[str, Any] = {
            name: min(MOST_ROWS, _round_up(math.ceil(factor * getattr(self, name)) + _SMALLEST))
            for name in _BYTES
            if name != "overlaps" or self.overlaps
        }
        return replace(self, **scaled)

    def grown(self, needed: BufferSizes) -> BufferSizes:
        """A capacity for a step that needed at least `needed` and stopped at the first overflow."""
        if needed.crowded and not self.crowded:
            needed = replace(needed, candidates=0, open=0)  # as many as listed all at once
        # Later stages saw only part of the pairs, so their counts are scaled up.
        more = max(1.0, needed.pairs / max(1, self.pairs), needed.overlaps / max(1, self.overlaps))
        enough = replace(
            needed,
            pairs=max(needed.pairs, min(needed.overlaps, math.ceil(more * needed.pairs))),
            **{name: math.ceil(more * getattr(needed, name)) for name in _BYTES if name not in ("pairs", "overlaps")},
        ).times(1.25)
        larger = {field.name: max(getattr(self, field.name), getattr(enough, field.name)) for field in fields(self)}
        return BufferSizes(**larger)

    def __repr__(self) -> str:
        return f"Capacity({', '.join(f'{name}={getattr(self, name)}' for name in _NAMES)})"

    @property
    def bytes(self) -> int:
        """Approximate GPU memory of buffers of this capacity, in bytes."""
        return sum(size * getattr(self, name) for name, size in _BYTES.items())

    @property
    def of_pairs(self) -> list[int]:
        """The `capacity` argument of `ops.pairs_padded`."""
        return [self.pairs, self.overlaps, int(self.long_rows)]

    @property
    def of_contacts(self) -> list[int]:
        """The `capacity` argument of `ops.contacts_padded`."""
        sizes = [self.poses, self.tasks, self.leaf_pairs, self.candidates, self.launches]
        return [*sizes, int(self.crowded), self.open, self.contacts]


_NAMES = tuple(field.name for field in fields(BufferSizes))


def sizes_of(capacity: Capacity) -> BufferSizes:
    """The sizes of a user's capacity. Raises TypeError or ValueError unless its rows fit 32-bit numbers."""
    if not isinstance(capacity, BufferSizes):
        hint = ": see Capacity.of and Stats.needed" if isinstance(capacity, int) else ""
        raise TypeError(f"capacity: expected a pgccd.Capacity, got {arguments.describe(capacity)}{hint}")
    for name in _NAMES:
        number = getattr(capacity, name)
        if not 0 <= number <= MOST_ROWS:
            raise ValueError(f"capacity: {name}: expected a number of rows from 0 to 2^31 - 1, got {number}")
    return capacity


def _round_up(number: int) -> int:
    """Rounds up to four significant binary digits, so that similar steps request equal sizes and the caching allocator
    reuses its blocks.
    """
    unit = 1 << max(0, number.bit_length() - 4)
    return -(-number // unit) * unit


#: On a CPU: as many rows as contacts are found.
EXACTLY = BufferSizes(pairs=0, contacts=_EXACT)


class CapacityError(RuntimeError):
    """A step exceeded its capacity.

    Attributes:
        capacity: of the step.
        needed: a lower bound of what the step needs: stages after the first overflow saw only part of the work.
        larger: a capacity for the next attempt.

    Example:
        >>> try:
        ...     hits = pgccd.detect(scene, motion, capacity=capacity).trim()
        ... except pgccd.CapacityError as error:
        ...     capacity = error.larger
    """

    capacity: Capacity
    needed: Capacity

    def __init__(self, capacity: BufferSizes, needed: BufferSizes) -> None:
        short = [
            f"{name}: {getattr(needed, name)} in {getattr(capacity, name)}"
            for name in _NAMES
            if getattr(needed, name) > getattr(capacity, name)
        ]
        super().__init__(capacity, needed)
        self._message = f"capacity: the step needs more: {', '.join(short)}; CapacityError.larger may suffice"
        self.capacity, self.needed = capacity, needed

    @property
    def larger(self) -> Capacity:
        return sizes_of(self.capacity).grown(sizes_of(self.needed))

    def __str__(self) -> str:
        return self._message


class Counts(NamedTuple):
    """Counts of one step, in the operators' order; times in nanoseconds of the device's clock."""

    pairs: int  # found
    overlaps: int
    long_rows: int
    pairs_written: int  # searched
    pairs_overflow: int
    broad_began: int
    broad_ended: int
    poses: int
    tasks: int
    leaf_pairs: int
    candidates: int
    tasks_left: int
    node_tests: int
    crowded: int
    traverse_overflow: int
    traverse_began: int
    traverse_ended: int
    open: int
    contacts: int
    unresolved: int
    contacts_overflow: int
    narrow_ended: int

    @classmethod
    def of(cls, values: Sequence[int]) -> Counts:
        """From the counts of both operators, concatenated."""
        return tuple.__new__(cls, values)

    @property
    def overflow(self) -> bool:
        """Whether any capacity was exceeded."""
        return bool(self.pairs_overflow or self.traverse_overflow or self.contacts_overflow)

    def needed(self, capacity: BufferSizes) -> BufferSizes:
        """The capacity that the step, run in `capacity`, would have needed."""
        return BufferSizes._of_checked(
            pairs=self.pairs,
            contacts=self.contacts,
            overlaps=self.overlaps,
            poses=self.poses,
            tasks=self.tasks,
            leaf_pairs=self.leaf_pairs,
            candidates=self.candidates,
            open=self.open,
            launches=max(1, 2 * capacity.launches) if self.tasks_left else capacity.launches,
            long_rows=self.long_rows != 0,
            crowded=capacity.crowded or self.crowded != 0,
        )

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage."""
        return {
            "broad": 1e-9 * (self.broad_ended - self.broad_began),
            "traverse": 1e-9 * (self.traverse_ended - self.traverse_began),
            "narrow": 1e-9 * (self.narrow_ended - self.traverse_ended),
        }


#: Index of each count.
COUNT_ROWS: dict[str, int] = {name: row for row, name in enumerate(Counts._fields)}
#: Number of counts of the broad phase.
COUNTS_OF_PAIRS = COUNT_ROWS["poses"]


def overflow_flags(counts: Tensor) -> list[Tensor]:
    """Flags (1,) int64, nonzero where a search with these counts (22,), or a sum of counts, exceeded a capacity."""
    rows = (COUNT_ROWS[f"{stage}_overflow"] for stage in ("pairs", "traverse", "contacts"))
    return [counts[row : row + 1] for row in rows]


def busy_nanoseconds(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """(ranks,): nanoseconds in which at least one pass was running; passes may overlap in time on a GPU.

    Args:
        counts: (ranks, passes, 22): `Counts` of each pass of a step.
    """
    began, ended = counts[:, :, COUNT_ROWS["traverse_began"]], counts[:, :, COUNT_ROWS["narrow_ended"]]
    order = np.argsort(began, axis=1)
    began, ended = np.take_along_axis(began, order, axis=1), np.take_along_axis(ended, order, axis=1)
    reached = np.maximum.accumulate(ended, axis=1)
    before = np.concatenate([began[:, :1], reached[:, :-1]], axis=1)
    return np.maximum(0, ended - np.maximum(began, before)).sum(axis=1)
