"""Results of `resolve`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from pgccd.contacts.rows import Columns
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.validation import Validation
from pgccd.runtime.sizes import BufferSizes, CapacityError, Counts

M = TypeVar("M", bound=RigidMotion | VertexMotion)


@dataclass(frozen=True, eq=False)
class Resolution(Columns, Generic[M]):
    """How far each of N bodies moves such that none meets another: the result of `pgccd.resolve`.

    Attributes:
        motion: the shortened motion, body i on x_i(fraction_i t), in the same step. Nothing touches on it except the
            pairs in `touching_at_start` and `unresolved`: detection has tested this motion as it is, rounding included.
        fraction: (N,) float64 in [0, 1], the part of its path that each body moves; 1 for bodies that nothing stopped
            and for those that may not be stopped.
        stopped_by: (N,) int64, index of the body whose contact stopped this one (its own index for a body that meets
            itself; the smallest if there are several at the same time); -1 where `fraction` is 1.
        touching_at_start: (S, 2) int64 pairs i <= j, sorted, that intersect, touch or are within min_separation and
            margins (plus the tolerance) at t = 0. Both bodies have fraction 0, unless they may not be stopped.
        unresolved: (U, 2) int64 pairs i <= j, sorted, that are not proven free on `motion` and of which at least one
            body moves. In each pair, a body that may not be stopped meets a body that was stopped, or another one that
            may not be stopped.
        rounds: number of detections after the first one, not counting the last one, which tests `motion`.
    """

    motion: M
    fraction: Tensor
    stopped_by: Tensor
    touching_at_start: Tensor
    unresolved: Tensor
    rounds: int

    _names: ClassVar[tuple[str, ...]] = ("fraction", "stopped_by", "touching_at_start", "unresolved")
    _parts: ClassVar[tuple[str, ...]] = ("motion",)

    # Motions are not compared.
    __eq__ = object.__eq__
    __hash__ = object.__hash__  # type: ignore[assignment]

    def __repr__(self) -> str:
        return (
            f"Resolution(bodies={len(self.fraction)}, rounds={self.rounds}, touching_at_start="
            f"{len(self.touching_at_start)}, unresolved={len(self.unresolved)}, device={self.fraction.device})"
        )


@dataclass(frozen=True, eq=False)
class PaddedResolution(Generic[M]):
    """A `Resolution` in a fixed number of rows, from `resolve(capacity=...)`: the host has not synchronised yet.

    The result is incomplete if a capacity was exceeded, a pose is invalid, or the last round still changed a body. Then
    `fraction` is 0 for every body, also for those that may not be stopped, and no pair is listed.

    Attributes:
        motion, fraction, stopped_by: as of `Resolution`.
        touching_at_start, unresolved: (K, 2) int64, as of `Resolution`; rows of -1, which may be anywhere, are padding.
        rounds: (1,) int64.
        incomplete: (1,) bool. `trim` raises the error.
    """

    motion: M
    fraction: Tensor
    stopped_by: Tensor
    touching_at_start: Tensor
    unresolved: Tensor
    rounds: Tensor
    incomplete: Tensor
    # (searches, 22): `Counts` of each; the values of `MovingBodies._first_invalid_rows`; (1,): nonzero if the last
    # round changed a body.
    _counts: Tensor = field(repr=False)
    _first_invalid_rows: Tensor = field(repr=False)
    _changes: Tensor = field(repr=False)
    _capacity: BufferSizes = field(repr=False)
    _validation: Validation = field(repr=False)

    def trim(self) -> Resolution[M]:
        """The resolution without padding. Synchronises.

        Raises:
            CapacityError: a capacity was exceeded.
            ValueError: the input is invalid.
            RuntimeError: the last round changed a body: more rounds are needed.

        Example:
            >>> resolved = pgccd.resolve(scene, motion, capacity=capacity).trim()
        """
        self._validation.raise_from(self._first_invalid_rows.tolist())
        needed = [counts.needed(self._capacity) for counts in map(Counts.of, self._counts.tolist()) if counts.overflow]
        if needed:
            raise CapacityError(self._capacity, _largest(needed))
        if int(self._changes):
            raise RuntimeError(f"rounds: more than {len(self._counts) - 2} are needed")
        touching, unresolved = (pairs[pairs[:, 0] >= 0] for pairs in (self.touching_at_start, self.unresolved))
        return Resolution(self.motion, self.fraction, self.stopped_by, touching, unresolved, int(self.rounds))

    def __repr__(self) -> str:
        return f"PaddedResolution(bodies={len(self.fraction)}, device={self.fraction.device})"


def _largest(capacities: list[BufferSizes]) -> BufferSizes:
    most: dict[str, Any] = {
        part.name: max(getattr(capacity, part.name) for capacity in capacities) for part in fields(BufferSizes)
    }
    return BufferSizes(**most)


def union_of_pairs(one: Tensor, other: Tensor, count: int) -> Tensor:
    """(P + Q, 2): the pairs in one or both of (P, 2) and (Q, 2), ascending, each once; rows of -1 may be anywhere.

    Args:
        count: number of bodies.
    """
    pairs = torch.cat([one, other])
    padding = count * count
    key = torch.where(pairs[:, 0] < 0, padding, count * pairs[:, 0] + pairs[:, 1]).sort().values
    is_new = torch.cat([key.new_ones(1, dtype=torch.bool)[: len(key)], key[1:] != key[:-1]]) & (key < padding)
    body = torch.div(key, max(1, count), rounding_mode="floor")
    return torch.where(is_new[:, None], torch.stack([body, key - body * count], dim=1), -1)
