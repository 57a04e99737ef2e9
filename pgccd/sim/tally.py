"""Counts of a step: the values of its line in the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.detection.capacity import COUNT_ROWS, busy_nanoseconds, overflow_flags
from pgccd.runtime.stages import StageClock
from pgccd.sim.hashing import hashed_columns
from pgccd.sim.model import RobotState

#: (ranks, k) int64: one row per rank.
Rows = NDArray[np.int64]


class Tally(NamedTuple):
    """Counts of a step, over all ranks: those of its searches, then those of `count_step`."""

    pcs: int
    contacts: int
    secondary_contacts: int
    candidates: int
    unresolved: int
    nanoseconds: int  #: of traversal and narrow phase of the whole step
    robots: int
    contacts_hash: int  #: modulo 2^64, like the other hashes
    state_hash: int
    stopped: int
    touching_at_t0: int
    id_hash: int

    @classmethod
    def of(cls, work: Rows, counted: Rows) -> Tally:
        """The sum over all ranks.

        Args:
            work: (ranks, 6).
            counted: (ranks, 6) by `count_step`.
        """
        sums = cls(*np.concatenate([work, counted], axis=1).sum(axis=0).tolist())  # int64, modulo 2^64
        hashes = {name: number % 2**64 for name, number in sums._asdict().items() if name.endswith("hash")}
        return sums._replace(**hashes)

    def record(self, index: int, rounds: int, clock: StageClock) -> dict[str, Any]:
        """The line of steps.jsonl."""
        stage_seconds = {stage: round(spent, 6) for stage, spent in clock.seconds.items()}  # first: it may synchronise
        return {
            "step": index,
            "robots": self.robots,
            "pcs": self.pcs,
            "contacts": self.contacts,
            "contacts_hash": f"{self.contacts_hash:016x}",
            "state_hash": f"{self.state_hash:016x}",
            "stopped": self.stopped,
            "secondary_contacts": self.secondary_contacts,
            "resolution_rounds": rounds,
            "touching_at_t0": self.touching_at_t0,
            "candidates": self.candidates,
            "unresolved": self.unresolved,
            "seconds": round(clock.total, 6),
            "stage_seconds": stage_seconds,
        }


#: The columns of a rank's searches; those of `count_step` follow.
WORK = Tally._fields[:6]
#: Number of values of `count_step`.
COUNTED = len(Tally._fields) - len(WORK)


class SearchCounts:
    """The counts of a rank's searches in a step, on the device.

    Args:
        of_parts: (21,) int64 of each part of the whole step: `pgccd.detection.capacity.Counts`.
        of_rounds: the same of each round of collision resolution.
    """

    def __init__(self, of_parts: Sequence[Tensor], of_rounds: Sequence[Tensor]) -> None:
        self._of_parts = of_parts
        self._in_rounds = torch.stack([torch.zeros_like(of_parts[0]), *of_rounds]).sum(dim=0)

    def overflow(self) -> list[Tensor]:
        """Flags (1,) int64: if any is nonzero, a capacity was exceeded."""
        return [flag for counts in (*self._of_parts, self._in_rounds) for flag in overflow_flags(counts)]

    def values(self) -> list[Tensor]:
        """What all ranks gather for `GatheredCounts`."""
        row = COUNT_ROWS["contacts"]
        return [self._in_rounds[row : row + 1], *self._of_parts]


class GatheredCounts(NamedTuple):
    """The `SearchCounts` of all ranks. Of rounds, only the contacts: the size does not depend on their number."""

    secondary_contacts: NDArray[np.int64]  #: (ranks,)
    of_parts: NDArray[np.int64]  #: (ranks, parts, 21)

    @staticmethod
    def width(parts: int) -> int:
        """Number of values of each rank."""
        return 1 + parts * len(COUNT_ROWS)

    @classmethod
    def of(cls, gathered: Rows) -> GatheredCounts:
        """`gathered`: (ranks, width)."""
        return cls(gathered[:, 0], gathered[:, 1:].reshape(len(gathered), -1, len(COUNT_ROWS)))

    @property
    def work(self) -> Rows:
        """(ranks, 6), columns as in `WORK`."""
        names = ("pairs_written", "contacts", "candidates", "unresolved")
        pcs, contacts, *rest = (self.of_parts[:, :, COUNT_ROWS[name]].sum(axis=1) for name in names)
        return np.stack([pcs, contacts, self.secondary_contacts, *rest, busy_nanoseconds(self.of_parts)], axis=1)


def count_step(after: RobotState, fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64 on the device: number of robots, hash of the contacts, hash of the state, number of robots that
    stopped, number of contacts at t0, hash of the robots' ids.

    Args:
        after: the state after the step.
        fraction: (N,) part of the step that each of these robots moved.
        id: (N + G,) ids of all held robots.
        pairs, toi: (K, 2) rows of `id` and (K,) toi of the contacts of the whole step; may be padded.
    """
    return ops.simulate_tally(hashed_columns(after), fraction, id, pairs, toi)
