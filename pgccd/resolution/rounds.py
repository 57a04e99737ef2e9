"""Rounds of resolution: the part of the step that each body moves such that none collides.

A body stops just before its first toi. Others may then collide with it, because they were tested as if it moved on. The
step is tested again, among the bodies just slowed down and between them and all others, until no round changes a body.
In the resulting step no two bodies touch that started apart and may both be stopped.

Several rounds are enqueued at a time, before it is known whether they are needed: superfluous rounds change nothing.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pgccd import ops
from pgccd.resolution.counts import GatheredCounts, Rows, SearchCounts
from pgccd.resolution.round_plan import RoundPlan
from pgccd.resolution.slowing import STOPPING_ROUND, SlowedBodies
from pgccd.resolution.stopped_by import StoppedBy
from pgccd.runtime.graph import conditional
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes, Counts
from pgccd.runtime.stages import StageClock
from pgccd.search.passes import SearchPass, search_seconds

# Rounds added at a time if those of the plan do not suffice.
_MORE_ROUNDS = 2
_CONTACTS = COUNT_ROWS["contacts"]


@dataclass
class Fractions:
    """The part of the step that each body moves such that none collides.

    Attributes:
        fraction: (N,) float64 in [0, 1]; below 1 for bodies that would collide.
        rounds: detections after the first.
        secondary_contacts: contacts found in rounds: with bodies that had stopped in the way.
    """

    fraction: Tensor
    rounds: int
    secondary_contacts: int

    @property
    def stopped(self) -> Tensor:
        """(N,) bool: whether the body moves less than the whole step."""
        return self.fraction < 1.0


@dataclass
class ResolvedStep:
    """Result of a step."""

    resolution: Fractions
    counts: GatheredCounts
    summaries: Rows  #: (ranks, k): the values of `summarise` of each rank
    #: Updates the capacity estimates for the next step; deferred, so that the next step can be enqueued first.
    learn: Callable[[], None]


class Found(NamedTuple):
    """First contacts of K pairs of bodies; rows of -1 are padding, or bodies that this rank does not resolve."""

    rows: Tensor  #: (K, 2) int64
    id: Tensor  #: (K, 2) int64: how `StoppedBy` name the bodies
    toi: Tensor  #: (K,) float64


def found_by(passes: Sequence[SearchPass], id: Tensor | None = None) -> list[Found]:
    """The first contacts of passes of report="first"; given the ids (N,) of the step's bodies, if they are not their
    rows. Does not synchronise.
    """
    found = [search_pass.first_contacts() for search_pass in passes]
    return [Found(pairs, pairs if id is None else ids_of(id, pairs), toi) for pairs, toi in found]


def ids_of(id: Tensor, rows: Tensor) -> Tensor:
    """The ids (N,) of rows (K, 2); -1 for -1."""
    return torch.where(rows < 0, -1, id[rows])


class RoundSearch(Protocol):
    """The searches of a step that is resolved: of the whole step, and in rounds, among bodies that have changed, and
    between them and all others.
    """

    @property
    def passes(self) -> Sequence[SearchPass]:
        """Of the whole step's pairs, for first contacts; the same number on all ranks."""
        ...

    @property
    def waits(self) -> bool:
        """Whether a round waits for its result, so that no superfluous one is started."""
        ...

    def find_whole(self) -> list[Found]:
        """The contacts of the whole step."""
        ...

    def look_again(self) -> None:
        """Takes note that the passes have found their pairs again, since they had exceeded their capacity."""
        ...

    def find_round(
        self, changed: Tensor, fraction: Tensor, capacity: BufferSizes, first: Tensor
    ) -> tuple[list[Found], Tensor]:
        """Searches a round. On a GPU does not synchronise, unless memory is short or it `waits`.

        Args:
            changed: (N,) uint8.
            fraction: (N,) float64: the part of its path that each body moves.
            capacity: of the round on a GPU; on a CPU sizes are exact.
            first: (N,) float64: first toi, relative to the part that each body moves. Lowered in place instead, if
                contacts are not listed.

        Returns:
            The contacts; and (22,) int64 on the device: `pgccd.runtime.sizes.Counts`.
        """
        ...


class Exchange(Protocol):
    """Messages between ranks."""

    @property
    def rank(self) -> int: ...

    @property
    def ranks(self) -> int: ...

    @property
    def shares_found(self) -> bool:
        """Whether `share` sets `anywhere`."""
        ...

    def share(self, first: Tensor, found: Tensor | None = None, anywhere: Tensor | None = None) -> None:
        """Sets the first toi (N,) of all bodies to the minimum over all ranks that hold them. If it `shares_found`, it
        also sets `anywhere` (1,) int64 to 1 if the number of contacts `found` (1,) int64 is nonzero on any rank.
        """
        ...

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        ...

    def any(self, value: Tensor) -> bool:
        """Whether value (1,) is nonzero on any rank. Synchronises."""
        ...


class OneRank:
    """The exchange of a single rank."""

    rank, ranks, shares_found = 0, 1, False

    def share(self, first: Tensor, found: Tensor | None = None, anywhere: Tensor | None = None) -> None:
        pass

    def gather(self, values: Tensor) -> Tensor:
        return values[None]

    def any(self, value: Tensor) -> bool:
        return bool(value)


#: Completes a step and summarises it, given the fractions (N,) float64 that the bodies move: returns (k,) int64 values
#: for all ranks. A later call with other fractions replaces the first.
Summarise = Callable[[Tensor], Tensor]


def resolve_collisions(
    search: RoundSearch,
    body_count: int,
    plan: RoundPlan,
    summarise: Summarise,
    clock: StageClock,
    exchange: Exchange | None = None,
    fixed: Tensor | None = None,
    stopped_by: StoppedBy | None = None,
    stopping_round: int = STOPPING_ROUND,
) -> ResolvedStep:
    """Finds the part of its path that each body moves.

    The host synchronises once, unless there are more rounds than in recent steps, a capacity was exceeded, or the
    search waits. All ranks make the same decision.

    Args:
        search: of the whole step and of rounds.
        body_count: number of bodies N.
        plan: number of rounds enqueued without waiting, and their capacities.
        summarise: see `Summarise`.
        clock: records stage times.
        exchange: between ranks; default: a single rank.
        fixed: (N,) bool: bodies that move by their whole step, whatever they meet; default: none.
        stopped_by: takes note of which body stopped which.
        stopping_round: from this round on a colliding body does not move at all.
    """
    exchange = exchange or OneRank()
    clock.add({"traverse": 0.0, "narrow": 0.0})  # lists the stages in the order of work
    for search_pass in search.passes:
        search_pass.begin()
    while True:
        attempt = Attempt(search, body_count, plan, exchange, clock, fixed, stopped_by, stopping_round)
        resolved = attempt.run(summarise)
        if resolved is not None:
            return resolved
        search.look_again()


@dataclass(eq=False)
class Attempt:
    """Rounds on the device, in given capacities: `begin`, then `make_rounds` until a round changes no body.

    Arguments as for `resolve_collisions`.
    """

    search: RoundSearch
    body_count: int
    plan: RoundPlan
    exchange: Exchange
    clock: StageClock
    fixed: Tensor | None = None
    stopped_by: StoppedBy | None = None
    stopping_round: int = STOPPING_ROUND

    def __post_init__(self) -> None:
        self.passes = self.search.passes
        self._device = self.passes[0].bodies.device
        self._bodies = SlowedBodies(self.body_count, self._device, self.fixed, self.stopping_round)
        #: Capacity of each round.
        self.capacities: list[BufferSizes] = []
        if self.stopped_by is not None:
            self.stopped_by.clear()

    @property
    def fraction(self) -> Tensor:
        """(N,) float64: the part of the step that each body moves."""
        return self._bodies.fraction

    def begin(self, change: Tensor | None = None) -> Tensor:
        """Slows down the bodies that collide in the whole step. Returns (1,) int64, `change` if given, of 0: nonzero if
        a body of this rank does.
        """
        if change is None:
            change = torch.zeros(1, dtype=torch.int64, device=self._device)
        self._slow_down(0, self.search.find_whole(), change)
        return change

    def make_rounds(self, count: int) -> tuple[Tensor, list[Tensor]]:
        """Enqueues rounds. Returns (count,) int64: nonzero for each round that changed a body of this rank; and the
        counts (22,) of each.
        """
        changes, counts = torch.zeros(count, dtype=torch.int64, device=self._device), []
        for change in changes.split(1) if count else ():
            counts.append(self._make_round(change))
        return changes, counts

    def run_replay(self, count: int, usual: int) -> tuple[Tensor, Tensor]:
        """`begin` and `make_rounds`, for a graph: replays skip superfluous rounds after the first `usual`; on several
        ranks only if the exchange `shares_found`. Returns the changes (1 + count,) and counts (count, 22).
        """
        numbers = torch.zeros((2, 1 + count), dtype=torch.int64, device=self._device)
        changes, anywhere = numbers
        counts = torch.zeros((count, len(COUNT_ROWS)), dtype=torch.int64, device=self._device)
        self.begin(changes[:1])
        is_alone = self.exchange.ranks == 1
        may_skip = is_alone or self.exchange.shares_found
        with ExitStack() as nested:
            for round in range(count):
                this, before = slice(round + 1, round + 2), slice(round, round + 1)
                if may_skip and round >= max(usual, 1):
                    # A body changes only if its rank, or another that holds it, found a contact.
                    nested.enter_context(conditional((changes if is_alone else anywhere)[before]))
                counts[round].copy_(self._make_round(changes[this], anywhere[this] if may_skip else None))
        return changes, counts

    def _make_round(self, change: Tensor, anywhere: Tensor | None = None) -> Tensor:
        """Enqueues a round, which sets `change` (1,) to nonzero if it changed a body of this rank, and `anywhere` (1,)
        if any rank found a contact, where the exchange `shares_found`. Returns its counts (22,).
        """
        capacity = self.plan.capacity(len(self.capacities))
        self.capacities.append(capacity)
        bodies = self._bodies
        found, counts = self.search.find_round(bodies.changed, bodies.fraction, capacity, bodies.first)
        number = counts[_CONTACTS : _CONTACTS + 1] if anywhere is not None else None
        self._slow_down(len(self.capacities), found, change, number, anywhere)
        return counts

    def _slow_down(
        self,
        round: int,
        contacts: list[Found],
        change: Tensor,
        found: Tensor | None = None,
        anywhere: Tensor | None = None,
    ) -> None:
        bodies, stopped_by = self._bodies, self.stopped_by
        for rows, _, toi in contacts:
            ops.resolve_first_toi(bodies.first, rows, toi)
        self.exchange.share(bodies.first, found, anywhere)
        if stopped_by is not None:
            for rows, id, toi in contacts:
                stopped_by.find(rows, id, toi, bodies.first)
        bodies.slow_down(round, change)
        if stopped_by is not None:
            stopped_by.note(bodies.changed)

    def run(self, summarise: Summarise) -> ResolvedStep | None:
        """Runs all rounds; None, on all ranks, if a rank exceeded a capacity, which has then grown."""
        exchange, clock = self.exchange, self.clock
        with clock.stage("respond"):
            changes = self.begin()
            # A single rank on the CPU can read the result of each round.
            reads_each = self.search.waits or (exchange.ranks == 1 and self._device.type == "cpu")
            more = int(exchange.any(changes)) if reads_each else self.plan.rounds_to_enqueue
        went_on: list[bool] = []  # for each round: whether a body had changed on any rank before it
        made: list[NDArray[np.int64]] = []  # counts of this rank, for each round
        secondary_contacts = np.zeros(exchange.ranks, dtype=np.int64)
        while True:
            with clock.stage("respond"):
                more_changes, counts = self.make_rounds(more)
                changes = torch.cat([changes, more_changes])
                while reads_each and more and exchange.any(changes[-1:]):
                    one_change, one_count = self.make_rounds(1)
                    changes, counts = torch.cat([changes, one_change]), counts + one_count
            searched = SearchCounts(
                [search_pass.counts() for search_pass in self.passes], torch.stack(counts) if counts else None
            )
            overflow = torch.cat(searched.overflow()).sum().reshape(1)
            mine = torch.cat([changes, overflow, *searched.values(), summarise(self.fraction)])
            with clock.stage("gather"):
                of_rounds = HostCopy.start(torch.cat([changes[:0], *counts]))
                numbers = HostCopy.start(exchange.gather(mine)).numpy()
            begin = len(changes) + 1
            end = begin + GatheredCounts.width(len(self.passes))
            gathered = GatheredCounts.of(numbers[:, begin:end])
            of_passes = gathered.of_passes[exchange.rank]
            of_new_rounds = list(of_rounds.numpy().reshape(len(counts), -1)) if counts else []
            if numbers[:, begin - 1].any():
                self._grow(of_passes, of_new_rounds, len(made))
                return None
            went_on += (numbers[:, : begin - 1].max(axis=0) > 0).tolist()
            secondary_contacts += gathered.secondary_contacts
            made += of_new_rounds
            if not all(went_on):
                rounds = went_on.index(False)
                needed = partial(_needed, made[:rounds], self.capacities)
                self.plan.learn(rounds, None if self._device.type == "cpu" else needed)
                resolution = Fractions(self.fraction, rounds, int(secondary_contacts[exchange.rank]))
                gathered = gathered._replace(secondary_contacts=secondary_contacts)
                return ResolvedStep(resolution, gathered, numbers[:, end:], self._learning(of_passes))
            more, changes = _MORE_ROUNDS, changes[:0]

    def _grow(self, of_passes: NDArray[np.int64], of_rounds: list[NDArray[np.int64]], first_round: int) -> None:
        for search_pass, numbers in zip(self.passes, of_passes.tolist(), strict=True):
            if Counts.of(numbers).overflow:
                search_pass.find()
        # Rounds after the first that overflowed saw only part of the contacts.
        for round, numbers in enumerate(of_rounds, first_round):
            counts = Counts.of(numbers.tolist())
            if counts.overflow:
                self.plan.grow(round, counts)
                return

    def _learning(self, of_passes: NDArray[np.int64]) -> Callable[[], None]:
        @cache
        def learn() -> None:
            for search_pass, numbers in zip(self.passes, of_passes.tolist(), strict=True):
                counts = Counts.of(numbers)
                search_pass.learn(counts)
                self.clock.add(search_seconds(counts))

        return learn


def _needed(made: Sequence[NDArray[np.int64]], capacities: Sequence[BufferSizes]) -> list[BufferSizes]:
    return [
        Counts.of(numbers.tolist()).needed(capacity)
        for numbers, capacity in zip(made, capacities[: len(made)], strict=True)
    ]
