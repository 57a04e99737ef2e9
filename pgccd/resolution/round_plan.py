"""How many rounds of collision resolution are enqueued before the host reads a result, and their capacities."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from pgccd.runtime.sizes import BufferSizes, Counts

# Rounds enqueued in the first step before its result is read.
_FIRST_ROUNDS = 4
# Number of recent steps considered.
_RECENT_STEPS = 8
# Capacity relative to what a round needed in the last step.
_SLACK = 2.0


class RoundPlan:
    """The number of rounds enqueued before the host reads a result, equal on all ranks, and the capacity of each on
    this rank. Owned by a simulation.
    """

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=_RECENT_STEPS)
        self._needed: Callable[[], Sequence[BufferSizes]] | None = None
        self._capacities: list[BufferSizes] = []

    @classmethod
    def of(cls, capacity: BufferSizes) -> RoundPlan:
        """A plan with this capacity of each round."""
        plan = cls()
        plan._capacities = [capacity]
        return plan

    @property
    def rounds_to_enqueue(self) -> int:
        """The largest number of rounds of recent steps: a superfluous round costs less than a synchronisation."""
        return max(self._recent, default=_FIRST_ROUNDS)

    def capacity(self, round: int) -> BufferSizes:
        """The capacity of a round, counted from 0."""
        if self._needed is not None:
            capacities = [capacity.times(_SLACK) for capacity in self._needed()]
            self._needed, self._capacities[: len(capacities)] = None, capacities
        if not self._capacities:
            return BufferSizes(0, 0).times(1.0)
        return self._capacities[min(round, len(self._capacities) - 1)]

    def grow(self, round: int, counts: Counts) -> None:
        """Grows the capacity of a round that overflowed."""
        capacities = [self.capacity(earlier) for earlier in range(max(round + 1, len(self._capacities)))]
        capacities[round] = capacities[round].grown(counts.needed(capacities[round]))
        self._capacities = capacities

    def learn(self, rounds: int, needed: Callable[[], Sequence[BufferSizes]]) -> None:
        """Records a step's rounds. The capacities are computed in the next step, while the host is idle."""
        self._recent.append(rounds)
        self._needed = needed
