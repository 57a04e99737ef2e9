"""Settling with several rounds at a time: a GPU makes most of them in less time than the host would wait for each, and
ranks agree once on whether there are more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeGuard

import torch
from torch import Tensor

from pgccd import ops
from pgccd.capacity import COUNT_ROWS, Capacity, Counts
from pgccd.parts import Part
from pgccd.sim.response import Exchange, Settlement, limits_of
from pgccd.stages import StageClock

# Rounds made at a time, after those that the last step took.
_MORE_ROUNDS = 2
# Times what a round needed in the last step.
_SLACK = 1.5


def goes_ahead(ahead: bool | None, device: torch.device, ranks: int = 1) -> bool:
    """Whether rounds are made several at a time; None: where there is a GPU or another rank to wait for."""
    return device.type != "cpu" or ranks > 1 if ahead is None else ahead


class Pace:
    """How many rounds the last step took, which is the same on all ranks, and what room they need on this one."""

    def __init__(self) -> None:
        #: None before the first step.
        self.rounds: int | None = None
        self._needed: Callable[[], Sequence[Capacity]] | None = None
        self._rooms: list[Capacity] = []

    def room(self, round: int) -> Capacity:
        """For a round, from 0."""
        if self._needed is not None:
            rooms = [capacity.times(_SLACK) for capacity in self._needed()]
            self._needed, self._rooms[: len(rooms)] = None, rooms
        return self._rooms[min(round, len(self._rooms) - 1)] if self._rooms else Capacity(0, 0).times(1.0)

    def learn(self, rounds: int, needed: Callable[[], Sequence[Capacity]]) -> None:
        """How many rounds a step took. What each needed is asked in the next one, when the host has time."""
        self.rounds, self._needed = rounds, needed


def knows_rounds(pace: Pace | None) -> TypeGuard[Pace]:
    """Whether rounds can be made ahead: how many there may be is known from the last step."""
    return pace is not None and pace.rounds is not None


class StartRound(Protocol):
    """Whom robots that have just been slowed down meet, found without waiting for a device."""

    def __call__(self, changed: Tensor, fraction: Tensor, room: Capacity, first: Tensor) -> Tensor:
        """Lowers the first toi of the robots that meet one that has changed, or have changed themselves.

        Args:
            changed: (N,) uint8.
            fraction: (N,) float64: what each robot is to make of the step.
            room: for the round.
            first: (N,) float64: first toi, in what each is to make of the step; lowered in place.

        Returns:
            (21,) int64, left on the device: `pgccd.capacity.Counts`.
        """
        ...


#: What follows once everybody knows how much of the step it makes, given (N,) float64 fractions: (k,) int64 numbers for
#: all ranks. Perhaps called again with others, when what it did before does not count.
Conclude = Callable[[Tensor], Tensor]


@dataclass
class Ahead:
    """What came of a step of which only the end was waited for."""

    settlement: Settlement
    told: list[list[int]]  #: what each rank concluded
    counts: list[list[Counts]]  #: of each rank's search for the contacts of the whole step, part by part
    secondary_contacts: list[int]  #: of each rank


def settle_ahead(
    parts: Sequence[Part],
    body_count: int,
    start_round: StartRound,
    exchange: Exchange,
    pace: Pace,
    conclude: Conclude,
    clock: StageClock,
) -> Ahead | None:
    """What `settle` decides, to the bit. Rounds are made without knowing whether they are needed: after the last one
    nobody has changed, and nothing comes of more.

    The host waits once, for the contacts of the whole step too, unless there are more rounds than in the last step.
    What decides how many are made is known to all ranks.

    Args:
        parts: of the whole step's pairs, as many on all ranks.
        body_count: number of robots N.
        start_round: starts a round.
        exchange: how ranks agree.
        pace: of a step before this one.
        conclude: what follows.
        clock: stages are timed here.

    Returns:
        None, on all ranks, if there was not room for something on one of them.
    """
    with clock.stage("respond"):
        device = parts[0].bodies.device
        fraction = torch.ones(body_count, dtype=torch.float64, device=device)
        changed = torch.empty(body_count, dtype=torch.uint8, device=device)
        first = torch.full_like(fraction, torch.inf)
        searches = [part.start() for part in parts]
        for part, search in zip(parts, searches, strict=True):
            ops.simulate_first_toi(first, part.rows, search.rows[0], search.rows[4])

    def slow_down(rounds: int) -> Tensor:
        exchange.share(first)
        return ops.simulate_slow_all_down(first, fraction, changed, *limits_of(rounds))

    with clock.stage("respond"):
        changes = [slow_down(0)]
    more = pace.rounds or 0
    goes_on: list[bool] = []  # before each round: whether a robot has changed on any rank
    made: list[tuple[Sequence[int], Capacity]] = []  # of each round: what this rank counted, and in what room
    secondary_contacts = [0] * exchange.ranks
    while True:
        counts, rooms = [search.counts[: len(COUNT_ROWS)] for search in searches], []
        with clock.stage("respond"):
            for round in range(len(made), len(made) + more):
                rooms.append(pace.room(round))
                counts.append(start_round(changed, fraction, rooms[-1], first))
                changes.append(slow_down(round + 1))
        mine = [*changes, *counts, conclude(fraction)]
        with clock.stage("gather"):
            told = exchange.gather(torch.cat(mine)).tolist()
        # By now a GPU has nothing to do: what can wait is put off.
        begin, size = len(changes), len(COUNT_ROWS)
        # The counts of parts come first, then those of rounds.
        end, in_rounds = begin + size * len(counts), begin + size * len(parts)
        if any(any(numbers[begin + row : end : size]) for numbers in told for row in _OVERFLOWS):
            return None
        goes_on += [any(numbers[round] for numbers in told) for round in range(begin)]
        for rank, numbers in enumerate(told):
            secondary_contacts[rank] += sum(numbers[in_rounds + COUNT_ROWS["contacts"] : end : size])
        made += [(told[exchange.rank][in_rounds + size * k :][:size], room) for k, room in enumerate(rooms)]
        if not all(goes_on):
            rounds = goes_on.index(False)
            pace.learn(rounds, partial(_needed, made[:rounds]))
            settlement = Settlement(fraction, rounds, secondary_contacts[exchange.rank])
            places = range(begin, in_rounds, size)
            of_parts = [[Counts.of(numbers[at : at + size]) for at in places] for numbers in told]
            return Ahead(settlement, [numbers[end:] for numbers in told], of_parts, secondary_contacts)
        changes, more = [], _MORE_ROUNDS


def _needed(made: Sequence[tuple[Sequence[int], Capacity]]) -> list[Capacity]:
    return [Counts.of(numbers).needed(room) for numbers, room in made]


_OVERFLOWS = [COUNT_ROWS[f"{stage}_overflow"] for stage in ("pairs", "traverse", "contacts")]
