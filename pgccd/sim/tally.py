"""What is counted in a step: the numbers of its line in the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from pgccd import ops
from pgccd.capacity import Counts
from pgccd.contacts import Stats
from pgccd.sim.hashing import hashed_columns
from pgccd.sim.world import RobotState
from pgccd.stages import StageClock

#: Numbers of `count_step`.
COUNTED = 6


@dataclass
class Work:
    """What a rank's searches found in a step, and how long it took: in the order of `Tally`."""

    pcs: int
    contacts: int
    secondary_contacts: int
    candidates: int
    unresolved: int
    nanoseconds: int  #: traversing and solving all pairs of the whole step

    @classmethod
    def of(cls, parts: Sequence[Stats | Counts], secondary_contacts: int) -> Work:
        """Of the search for the contacts of the whole step, part by part."""
        pcs = sum(part.pairs_written if isinstance(part, Counts) else part.pcs for part in parts)
        contacts, candidates, unresolved = (
            sum(getattr(part, name) for part in parts) for name in ("contacts", "candidates", "unresolved")
        )
        seconds = sum(part.seconds["traverse"] + part.seconds["narrow"] for part in parts)
        return cls(pcs, contacts, secondary_contacts, candidates, unresolved, round(1e9 * seconds))


@dataclass
class Tally:
    """What is counted in a step. The tallies of parts of a world add up to that of the whole."""

    # What the searches counted first, then what `count_step` does.
    pcs: int
    contacts: int
    secondary_contacts: int
    candidates: int
    unresolved: int
    robots: int
    contacts_hash: int  #: modulo 2^64, as the next
    state_hash: int
    stopped: int
    touching_at_t0: int
    id_hash: int  #: modulo 2^64

    @classmethod
    def of(cls, work: Work, counted: Sequence[int]) -> Tally:
        """Of what `count_step` counted, hashes perhaps signed."""
        robots, contacts_hash, state_hash, stopped, touching_at_t0, id_hash = counted
        hashes = contacts_hash % 2**64, state_hash % 2**64
        found = work.pcs, work.contacts, work.secondary_contacts, work.candidates, work.unresolved
        return cls(*found, robots, *hashes, stopped, touching_at_t0, id_hash % 2**64)

    @classmethod
    def total(cls, parts: Sequence[Tally]) -> Tally:
        """Of the whole."""
        sums = {field.name: sum(getattr(part, field.name) for part in parts) for field in fields(cls)}
        for name in ("contacts_hash", "state_hash", "id_hash"):
            sums[name] %= 2**64
        return cls(**sums)

    def record(self, index: int, rounds: int, clock: StageClock) -> dict[str, Any]:
        """The line of steps.jsonl."""
        stage_seconds = {stage: round(spent, 6) for stage, spent in clock.seconds.items()}  # first: it may have to wait
        return {
            "step": index,
            "robots": self.robots,
            "pcs": self.pcs,
            "contacts": self.contacts,
            "contacts_hash": f"{self.contacts_hash:016x}",
            "state_hash": f"{self.state_hash:016x}",
            "stopped": self.stopped,
            "secondary_contacts": self.secondary_contacts,
            "settle_rounds": rounds,
            "touching_at_t0": self.touching_at_t0,
            "candidates": self.candidates,
            "unresolved": self.unresolved,
            "seconds": round(clock.total, 6),
            "stage_seconds": stage_seconds,
        }


def count_step(after: RobotState, fraction: Tensor, id: Tensor, pairs: Tensor, toi: Tensor) -> Tensor:
    """(6,) int64, left on the device: robots, hash of the contacts, hash of the state, robots that stopped, contacts at
    t0, hash of the robots' ids.

    Args:
        after: the state after the step.
        fraction: (N,) of it that each of these robots made.
        id: (N + G,) of all robots held.
        pairs, toi: (K, 2) rows of these and (K,) of the contacts of the whole step, perhaps with padding.
    """
    return ops.simulate_tally(hashed_columns(after), fraction, id, pairs, toi)
