"""How many rounds of collision resolution are enqueued, or captured, before the host reads a result; and their
capacities.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from pgccd.runtime.sizes import BufferSizes, Counts

# Rounds enqueued in the first step before its result is read.
_FIRST_ROUNDS = 4
# Number of recent steps considered.
_RECENT_STEPS = 8
# Capacity relative to what a round needed in the last step, and before any is known.
_SLACK = 2.0
_FIRST_CAPACITY = BufferSizes(0, 0).times(1.0)

# A graph has more rounds of collision resolution than any recent step took: the step that needs one more is repeated,
# and another graph captured, which takes as long as several hundred superfluous rounds.
_STEPS_OF_GRAPH, _SPARE_ROUNDS = 512, 1
# Steps from which the usual number of rounds is taken: fewer, since it grows in the first hundred steps.
_USUAL_STEPS = 16


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
            return _FIRST_CAPACITY
        return self._capacities[min(round, len(self._capacities) - 1)]

    def grow(self, round: int, counts: Counts) -> None:
        """Grows the capacity of a round that overflowed."""
        capacities = [self.capacity(earlier) for earlier in range(max(round + 1, len(self._capacities)))]
        capacities[round] = capacities[round].grown(counts.needed(capacities[round]))
        self._capacities = capacities

    def learn(self, rounds: int, needed: Callable[[], Sequence[BufferSizes]] | None) -> None:
        """Records a step's rounds. The capacities are computed in the next step, while the host is idle; None: a CPU
        needs none.
        """
        self._recent.append(rounds)
        self._needed = needed


class RecentRounds:
    """Numbers of rounds of collision resolution in recent steps: a graph has more than any of them took."""

    def __init__(self) -> None:
        self._rounds: deque[int] = deque(maxlen=_STEPS_OF_GRAPH)

    def note(self, rounds: int) -> None:
        """Records the rounds of a step."""
        self._rounds.append(rounds)

    @property
    def to_capture(self) -> int:
        """Rounds of a graph."""
        return max(self._rounds) + _SPARE_ROUNDS

    @property
    def usual(self) -> int:
        """Rounds that three of four recent steps needed. A conditional part of a graph costs a third as much as a
        superfluous round.
        """
        recent = sorted(list(self._rounds)[-_USUAL_STEPS:])
        return recent[len(recent) // 4]

    def need_fewer_than(self, rounds: int) -> bool:
        """Whether a graph with so many rounds has more than needed."""
        return len(self._rounds) == _STEPS_OF_GRAPH and self.to_capture < rounds
