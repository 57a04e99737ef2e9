"""Results in a fixed number of rows, which the host has not read yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import torch
from torch import Tensor

from pgccd.contacts.by_body import By, SceneBodies, any_contact
from pgccd.contacts.contacts import CollidingPairs, ContactColumns, Contacts, PairColumns, Stats
from pgccd.motion.validation import Validation
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes, Capacity, CapacityError, Counts, overflow_flags, sizes_of


@dataclass(eq=False, kw_only=True, repr=False)
class PaddedRows(PairColumns):
    """What padded results have: counts on the device."""

    count: Tensor
    overflow: Tensor
    counts: Tensor
    capacity: Capacity
    broad_phase: str
    _bodies: SceneBodies
    _validation: Validation
    # `PaddedSearch.reach`.
    _reach: Tensor | None = field(default=None, repr=False, compare=False)

    @property
    def invalid(self) -> Tensor:
        """(1,) bool: a pose is invalid. Where `overflow` is set and this is not, a capacity was exceeded."""
        return self.counts[-1:] != 0

    @property
    def _incomplete(self) -> Tensor:
        return self.overflow

    def may_collide(self, by: By = "scene") -> Tensor:
        if by == "scene" or self._reach is None:
            return super().may_collide(by)
        lost = torch.cat(overflow_flags(self.counts)).any()
        return self._any_contact(by) | lost | self._in_invalid_worlds(self._reach, by)

    def _in_invalid_worlds(self, reach: Tensor, by: By) -> Tensor:
        """Which worlds (W,) have an invalid body, or which bodies (N,) are in these."""
        rows = torch.arange(len(reach), device=reach.device)
        invalid = torch.where(reach < 0.0, rows, -1)[:, None].expand(-1, 2)
        of_world, world = any_contact(invalid, self._bodies, "world"), self.world
        if by == "world":
            return of_world
        return of_world.expand(len(reach)) if world is None else of_world[world.long()]

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        mapped = super()._map(change)
        for name in ("count", "overflow", "counts", "_reach", "_found_toi"):
            if (column := getattr(self, name, None)) is not None:
                setattr(mapped, name, change(column))
        return mapped

    def _trimmed(self) -> dict[str, Any]:
        """The columns without padding, and stats. Synchronises."""
        capacity = sizes_of(self.capacity)
        counts = checked_counts(self.counts.tolist(), capacity, self._validation)
        count = min(counts.contacts, len(self.pairs))  # "earliest" has one row
        columns = {name: column[:count] for name, column in self.columns.items()}
        waits = int(self.counts.is_cuda)
        stats = stats_of(counts, capacity, self._bodies.count, count, self.broad_phase, waits)
        return columns | {"stats": stats, "_bodies": self._bodies}

    def __repr__(self) -> str:
        return f"{type(self).__name__}(capacity={len(self.pairs)}, device={self.pairs.device})"


@dataclass(eq=False, kw_only=True, repr=False)
class PaddedContacts(ContactColumns, PaddedRows):
    """Contacts in a fixed number of rows, from `detect(capacity=...)`: the host has not synchronised yet.

    The first `count` rows are contacts as in `Contacts`. The rest is padding: pairs and features -1, toi inf, status
    FREE, all else 0, so `toi.min()` needs no mask.

    The result is incomplete if a capacity was exceeded or a pose is invalid. It then reads as a contact at the start of
    the step, whatever was found: toi is 0 in every row, padding included, `first_toi` is 0, and `may_collide` is True
    for the scene, each world and each body. There is one exception: if no capacity was exceeded, only rigid poses are
    invalid and no pairs were given, worlds without an invalid body keep their `first_toi` and `may_collide`. A loop
    that reads only these stands still until the host has read the counts: in `trim` after `detect(capacity=...)`, or
    two calls later with a `CapturedDetection`.

    Attributes:
        pairs, toi, kind, features, coordinates, point, normal, status: as of `Contacts`, with padding.
        count: (1,) int64: number of contacts found.
        overflow: (1,) bool: the result is incomplete; `trim` raises the error.
        counts: (22 + F,) int64: `pgccd.runtime.sizes.Counts`, then the first invalid rows of poses and columns.
        capacity: of the result and of all intermediate lists.
        broad_phase: as in `Stats`.
    """

    # The toi as found. In an incomplete result, `toi` is 0.
    _found_toi: Tensor | None = field(default=None, repr=False, compare=False)

    def first_toi(self, by: By = "scene") -> Tensor:
        if by == "scene" or self._reach is None or self._found_toi is None:
            return super().first_toi(by)
        lost = torch.cat(overflow_flags(self.counts)).any()
        found = self._first_time(self._found_toi, by, lost)
        return found.masked_fill(self._in_invalid_worlds(self._reach, by), 0.0)

    def trim(self) -> Contacts:
        """The contacts without padding, with stats. Synchronises.

        Raises:
            CapacityError: a capacity was exceeded.
            ValueError: the input is invalid.

        Example:
            >>> hits = pgccd.detect(scene, motion, capacity=capacity).trim()
        """
        return Contacts(**self._trimmed(), _is_earliest=self._is_earliest)


@dataclass(eq=False, kw_only=True, repr=False)
class PaddedCollidingPairs(PaddedRows):
    """Colliding pairs in a fixed number of rows, from `collide(capacity=...)`: the host has not synchronised yet.
    Padding is -1. If the result is incomplete, `may_collide` is True, as for `PaddedContacts`.

    Attributes:
        pairs: (K, 2) int64, as of `CollidingPairs`, with padding.
        count, overflow, counts, capacity, broad_phase: as of `PaddedContacts`.
    """

    def trim(self) -> CollidingPairs:
        """The pairs without padding, with stats. Synchronises.

        Raises:
            CapacityError: a capacity was exceeded.
            ValueError: the input is invalid.

        Example:
            >>> colliding = pgccd.collide(scene, motion, capacity=capacity).trim()
        """
        return CollidingPairs(**self._trimmed())


def checked_counts(values: Sequence[int], capacity: BufferSizes, validation: Validation, later: bool = False) -> Counts:
    """The counts of a padded step, from the values of `PaddedContacts.counts`; later: see `Validation.raise_from`.

    Raises:
        CapacityError: a capacity was exceeded.
        ValueError: the input is invalid.
    """
    validation.raise_from(values[len(COUNT_ROWS) :], later)
    counts = Counts.of(values[: len(COUNT_ROWS)])
    if counts.overflow:
        raise CapacityError(capacity, counts.needed(capacity))
    return counts


def stats_of(counts: Counts, capacity: BufferSizes, bodies: int, contacts: int, broad_phase: str, waits: int) -> Stats:
    """Statistics of a step that was run at once, in `capacity`."""
    return Stats(
        bodies=bodies,
        pcs=counts.pairs_written,
        node_tests=counts.node_tests,
        candidates=counts.candidates,
        contacts=contacts,
        unresolved=counts.unresolved,
        broad_phase=broad_phase,
        chunks=1,
        waits=waits,
        needed=counts.needed(capacity),
        seconds=counts.seconds,
    )
