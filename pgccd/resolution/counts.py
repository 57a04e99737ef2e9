"""Counts of the searches of a step that is resolved, on one rank and on all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd.runtime.sizes import COUNT_ROWS, busy_nanoseconds, overflow_flags

#: (ranks, k) int64: one row per rank.
Rows = NDArray[np.int64]


class SearchCounts:
    """The counts of a rank's searches in a step, on the device.

    Args:
        of_passes: (22,) int64 of each pass of the whole step: `pgccd.runtime.sizes.Counts`.
        of_rounds: (rounds, 22): the same of each round of collision resolution; None if there was none.
    """

    def __init__(self, of_passes: Sequence[Tensor], of_rounds: Tensor | None) -> None:
        self._of_passes = of_passes
        self._in_rounds = torch.zeros_like(of_passes[0]) if of_rounds is None else of_rounds.sum(dim=0)

    def overflow(self) -> list[Tensor]:
        """Flags (1,) int64: if any is nonzero, a capacity was exceeded."""
        return [flag for counts in (*self._of_passes, self._in_rounds) for flag in overflow_flags(counts)]

    def values(self) -> list[Tensor]:
        """What all ranks gather for `GatheredCounts`."""
        row = COUNT_ROWS["contacts"]
        return [self._in_rounds[row : row + 1], *self._of_passes]


class GatheredCounts(NamedTuple):
    """The `SearchCounts` of all ranks. Of rounds, only the contacts: the size does not depend on their number."""

    secondary_contacts: NDArray[np.int64]  #: (ranks,)
    of_passes: NDArray[np.int64]  #: (ranks, passes, 22)

    @staticmethod
    def width(passes: int) -> int:
        """Number of values of each rank."""
        return 1 + passes * len(COUNT_ROWS)

    @classmethod
    def of(cls, gathered: Rows) -> GatheredCounts:
        """`gathered`: (ranks, width)."""
        return cls(gathered[:, 0], gathered[:, 1:].reshape(len(gathered), -1, len(COUNT_ROWS)))

    @property
    def listed(self) -> tuple[int, int]:
        """Number of pairs listed for rounds, and of those among them in the PCS, of all ranks."""
        listed, pcs = (int(self.of_passes[:, :, COUNT_ROWS[name]].sum()) for name in ("pairs", "pairs_written"))
        return listed, pcs

    @property
    def work(self) -> Rows:
        """(ranks, 6): pairs, contacts, contacts of rounds, candidates and unresolved contacts of the whole step, and
        nanoseconds of its traversal and narrow phase."""
        names = ("pairs_written", "contacts", "candidates", "unresolved")
        pcs, contacts, *rest = (self.of_passes[:, :, COUNT_ROWS[name]].sum(axis=1) for name in names)
        return np.stack([pcs, contacts, self.secondary_contacts, *rest, busy_nanoseconds(self.of_passes)], axis=1)
