"""Settling with several rounds at a time: a GPU makes most of them in less time than the host would wait for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from pgccd import ops
from pgccd.capacity import COUNT_ROWS, Capacity, Counts
from pgccd.sim.response import Exchange, Settlement, first_collisions, limits_of

# Rounds made at a time, after those that the last step took.
_MORE_ROUNDS = 2
# Times what a round needed in the last step.
_SLACK = 1.5


def goes_ahead(ahead: bool | None, device: torch.device) -> bool:
    """Whether rounds are made several at a time; None: where it saves something, which is on a GPU."""
    return device.type != "cpu" if ahead is None else ahead


class Pace:
    """How many rounds the last step took, which is the same on all ranks, and what room they need on this one."""

    def __init__(self) -> None:
        #: None before the first step.
        self.rounds: int | None = None
        self._rooms: list[Capacity] = []

    def room(self, round: int) -> Capacity:
        """For a round, from 0."""
        return self._rooms[min(round, len(self._rooms) - 1)] if self._rooms else Capacity(0, 0).times(1.0)

    def learn(self, needed: Sequence[Capacity]) -> None:
        """What each round of a step needed."""
        self.rounds = len(needed)
        self._rooms[: len(needed)] = [capacity.times(_SLACK) for capacity in needed]


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


def settle_ahead(
    pairs: Tensor, toi: Tensor, body_count: int, start_round: StartRound, exchange: Exchange, pace: Pace
) -> Settlement | None:
    """What `settle` decides, to the bit. Rounds are made without knowing whether they are needed: after the last one
    nobody has changed, and nothing comes of more.

    The host waits once, unless there are more rounds than in the last step. What decides how many are made is known to
    all ranks.

    Args:
        pairs, toi: the contacts (K, 2) and (K,) of the whole step.
        body_count: number of robots N.
        start_round: starts a round.
        exchange: how ranks agree.
        pace: of a step before this one.

    Returns:
        None, on all ranks, if there was not room for a round on one of them.
    """
    fraction = torch.ones(body_count, dtype=torch.float64, device=toi.device)
    changed = torch.empty(body_count, dtype=torch.uint8, device=toi.device)
    first = first_collisions(pairs, toi, body_count)

    def slow_down(rounds: int) -> Tensor:
        exchange.share(first)
        return ops.simulate_slow_all_down(first, fraction, changed, *limits_of(rounds))

    changes, more = [slow_down(0)], pace.rounds or 0
    goes_on: list[bool] = []  # before each round: whether a robot has changed on any rank
    needed: list[Capacity] = []
    secondary_contacts = 0
    while True:
        counts, rooms = [], []
        for round in range(len(needed), len(needed) + more):
            rooms.append(pace.room(round))
            counts.append(start_round(changed, fraction, rooms[-1], first))
            changes.append(slow_down(round + 1))
        told = exchange.gather(torch.cat([*changes, *counts])).tolist()
        made = [_counts_of(numbers[len(changes) :]) for numbers in told]
        if any(count.overflow for of_rank in made for count in of_rank):
            return None
        goes_on += [any(flags) for flags in zip(*(numbers[: len(changes)] for numbers in told), strict=True)]
        own = made[exchange.rank]
        needed += [count.needed(room) for count, room in zip(own, rooms, strict=True)]
        secondary_contacts += sum(count.contacts for count in own)
        if not all(goes_on):
            rounds = goes_on.index(False)
            pace.learn(needed[:rounds])
            return Settlement(fraction, rounds, secondary_contacts)
        changes, more = [], _MORE_ROUNDS


def _counts_of(numbers: list[int]) -> list[Counts]:
    return [Counts.of(numbers[k : k + len(COUNT_ROWS)]) for k in range(0, len(numbers), len(COUNT_ROWS))]
