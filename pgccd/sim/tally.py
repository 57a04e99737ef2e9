"""Counts of a step: the values of its line in the log."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from pgccd import ops
from pgccd.resolution.counts import Rows
from pgccd.runtime.stages import StageClock
from pgccd.sim.model import RobotState
from pgccd.sim.state_hashes import hashed_columns


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


#: The columns of `GatheredCounts.work`; those of `count_step` follow.
WORK = Tally._fields[:6]
#: Number of values of `count_step`.
COUNTED = len(Tally._fields) - len(WORK)


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
