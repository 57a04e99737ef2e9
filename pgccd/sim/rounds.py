"""Settling with several rounds at a time: a GPU makes most of them in less time than the host would wait for each, and
ranks agree once on whether there are more.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.detection.capacity import COUNT_ROWS, Capacity, Counts
from pgccd.detection.parts import Part
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.stages import StageClock
from pgccd.sim.response import Exchange, Resolution, limits_of
from pgccd.sim.tally import Rows

# Rounds made at a time, after as many as any of the last steps took.
_MORE_ROUNDS = 2
# How many steps count as the last.
_REMEMBERED = 8
# Times what a round needed in the last step.
_SLACK = 1.5


def goes_ahead(ahead: bool | None, device: torch.device, ranks: int = 1) -> bool:
    """Whether rounds are made several at a time; None: where there is a GPU or another rank to wait for."""
    return device.type != "cpu" or ranks > 1 if ahead is None else ahead


class Pace:
    """How many rounds the last steps took, which is the same on all ranks, and the capacity they need on this one."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=_REMEMBERED)
        self._needed: Callable[[], Sequence[Capacity]] | None = None
        self._capacities: list[Capacity] = []

    @property
    def rounds(self) -> int | None:
        """The most that any of the last steps took; None before the first."""
        # A round too many costs less than to find out that there is one more.
        return max(self._recent, default=None)

    def capacity(self, round: int) -> Capacity:
        """For a round, from 0."""
        if self._needed is not None:
            capacities = [capacity.times(_SLACK) for capacity in self._needed()]
            self._needed, self._capacities[: len(capacities)] = None, capacities
        return (
            self._capacities[min(round, len(self._capacities) - 1)] if self._capacities else Capacity(0, 0).times(1.0)
        )

    def learn(self, rounds: int, needed: Callable[[], Sequence[Capacity]]) -> None:
        """How many rounds a step took. What each needed is asked in the next one, when the host has time."""
        self._recent.append(rounds)
        self._needed = needed


def knows_rounds(pace: Pace | None) -> TypeGuard[Pace]:
    """Whether rounds can be made ahead: how many there may be is known from the last steps."""
    return pace is not None and pace.rounds is not None


class StartRound(Protocol):
    """Whom robots that have just been slowed down meet, found without waiting for a device."""

    def __call__(self, changed: Tensor, fraction: Tensor, capacity: Capacity, first: Tensor) -> Tensor:
        """Lowers the first toi of the robots that meet one that has changed, or have changed themselves.

        Args:
            changed: (N,) uint8.
            fraction: (N,) float64: what each robot is to make of the step.
            capacity: of the round.
            first: (N,) float64: first toi, in what each is to make of the step; lowered in place.

        Returns:
            (21,) int64, left on the device: `pgccd.detection.capacity.Counts`.
        """
        ...


#: Concludes a step, given the fractions (N,) float64 that the robots move: returns (k,) int64 numbers for all ranks.
#: May be called again with other fractions, which replace the first.
Conclude = Callable[[Tensor], Tensor]

#: Work that can be enqueued before the host has read the conclusion. Its argument (1,) int64 stays on the device;
#: nonzero: speculation failed (more rounds are needed, or a capacity was exceeded), discard.
Meanwhile = Callable[[Tensor], None]


@dataclass
class Ahead:
    """What came of a step of which only the end was waited for."""

    resolution: Resolution
    conclusions: Rows  #: (ranks, k): the numbers that each rank concluded
    counts: NDArray[np.int64]  #: (ranks, parts, 21): `Counts` of each one's search for the contacts of the whole step
    secondary_contacts: NDArray[np.int64]  #: (ranks,)


def resolve_ahead(
    parts: Sequence[Part],
    body_count: int,
    start_round: StartRound,
    exchange: Exchange,
    pace: Pace,
    conclude: Conclude,
    clock: StageClock,
    meanwhile: Meanwhile | None = None,
) -> Ahead | None:
    """The result of `resolve_collisions`, to the bit. Rounds are enqueued before it is known whether they are needed: a
    round after the last one that changed a robot changes nothing.

    The host waits once, for the contacts of the whole step too, unless there are more rounds than in the last steps.
    What decides how many are made is known to all ranks.

    Args:
        parts: of the whole step's pairs, as many on all ranks.
        body_count: number of robots N.
        start_round: starts a round.
        exchange: how ranks agree.
        pace: of the steps before this one.
        conclude: what follows.
        clock: stages are timed here.
        meanwhile: work of the next step to enqueue before waiting.

    Returns:
        None, on all ranks, if a capacity was exceeded on one of them.
    """
    more = pace.rounds or 0
    device = parts[0].bodies.device
    with clock.stage("respond"):
        fraction = torch.ones(body_count, dtype=torch.float64, device=device)
        changed = torch.empty(body_count, dtype=torch.uint8, device=device)
        first = torch.full_like(fraction, torch.inf)
        searches = [part.start() for part in parts]
        for part, search in zip(parts, searches, strict=True):
            ops.simulate_first_toi(first, part.rows, search.rows[0], search.rows[4])

        def slow_down(rounds: int, changes: Tensor) -> None:
            exchange.share(first)
            ops.simulate_slow_all_down(first, fraction, changed, changes, *limits_of(rounds))

        changes = torch.zeros(1 + more, dtype=torch.int64, device=device)  # whether a robot changed, in each round
        slow_down(0, changes[:1])
    goes_on: list[bool] = []  # before each round: whether a robot has changed on any rank
    made: list[tuple[NDArray[np.int64], Capacity]] = []  # of each round: what this rank counted, and its capacity
    secondary_contacts = np.zeros(exchange.ranks, dtype=np.int64)
    while True:
        counts, capacities = [search.counts[: len(COUNT_ROWS)] for search in searches], []
        with clock.stage("respond"):
            for round, changes_now in enumerate(changes.split(1)[len(changes) - more :], len(made)):
                capacities.append(pace.capacity(round))
                counts.append(start_round(changed, fraction, capacities[-1], first))
                slow_down(round + 1, changes_now)
        mine = [changes, *counts, conclude(fraction)]
        with clock.stage("gather"):
            gathered = exchange.gather(torch.cat(mine))
            on_host = HostCopy(gathered)
        if meanwhile is not None:
            meanwhile(gathered[:, len(changes) - 1].amax(dim=0, keepdim=True))
        with clock.stage("gather"):
            numbers = on_host.numpy()
        begin, end = len(changes), len(changes) + len(COUNT_ROWS) * len(counts)
        searched = numbers[:, begin:end].reshape(exchange.ranks, len(counts), len(COUNT_ROWS))
        if searched[:, :, _OVERFLOWS].any():
            return None
        goes_on += (numbers[:, :begin].max(axis=0) > 0).tolist()
        # The counts of parts come first, then those of rounds.
        of_parts, of_rounds = searched[:, : len(parts)], searched[:, len(parts) :]
        secondary_contacts += of_rounds[:, :, COUNT_ROWS["contacts"]].sum(axis=1)
        made += zip(of_rounds[exchange.rank], capacities, strict=True)
        if not all(goes_on):
            rounds = goes_on.index(False)
            pace.learn(rounds, partial(_needed, made[:rounds]))
            resolution = Resolution(fraction, rounds, int(secondary_contacts[exchange.rank]))
            return Ahead(resolution, numbers[:, end:], of_parts, secondary_contacts)
        more = _MORE_ROUNDS
        changes = torch.zeros(more, dtype=torch.int64, device=device)


def _needed(made: Sequence[tuple[NDArray[np.int64], Capacity]]) -> list[Capacity]:
    return [Counts.of(numbers.tolist()).needed(capacity) for numbers, capacity in made]


_OVERFLOWS = [COUNT_ROWS[f"{stage}_overflow"] for stage in ("pairs", "traverse", "contacts")]
