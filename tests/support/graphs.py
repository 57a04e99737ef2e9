"""Replacements for CUDA graphs and events where there is no GPU: a replay repeats the work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from pgccd.distributed.halo import halo_sizes
from pgccd.distributed.steps import replayed
from pgccd.resolution import rounds as rounds_module
from pgccd.runtime import transaction
from pgccd.runtime.sizes import COUNT_ROWS


class Recorded:
    """A graph; its replay repeats the work."""

    def __init__(self, work: Callable[[], Tensor]) -> None:
        self._work, self._found = work, work()

    def replay(self) -> None:
        self._found.copy_(self._work())

    def reset(self) -> None:
        del self._work


class Now:
    """An event that has always completed."""

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, _: Now) -> float:
        return 1.0


def record(work: Callable[[], Tensor], device: torch.device) -> tuple[Any, Tensor]:
    """Replaces `pgccd.runtime.graph.capture`."""
    work()
    graph = Recorded(work)
    return graph, graph._found


class ConditionalRounds:
    """Skips rounds of collision resolution in conditional parts that are not wanted. Replaces
    `pgccd.runtime.graph.conditional` and `Attempt._make_round`.
    """

    def __init__(self) -> None:
        self.skipped, self._unwanted, self._make_round = 0, 0, rounds_module.Attempt._make_round

    @contextmanager
    def conditional(self, value: Tensor) -> Iterator[None]:
        assert value.shape == (1,) and value.dtype == torch.int64
        is_unwanted = int(value) == 0
        self._unwanted += is_unwanted
        yield
        self._unwanted -= is_unwanted

    def make_round(self, attempt: rounds_module.Attempt, change: Tensor, anywhere: Tensor | None = None) -> Tensor:
        if not self._unwanted:
            return self._make_round(attempt, change, anywhere)
        self.skipped += 1
        attempt.capacities.append(attempt.plan.capacity(len(attempt.capacities)))
        return torch.zeros(len(COUNT_ROWS), dtype=torch.int64)


class Graphs(ExitStack):
    """A context in which steps can be captured."""

    rounds: ConditionalRounds | None = None  #: on a CPU

    def without_room(self) -> None:
        """One more body in any message overflows it."""
        self.enter_context(mock.patch.object(halo_sizes, "padded_count", lambda count: count))
        self.enter_context(mock.patch.object(halo_sizes, "_NEAR_SLACK", 1))
        self.enter_context(mock.patch.object(replayed, "_OWN_MORE", 0))

    def replays_with_away(self, weight: float) -> None:
        """Steps are replayed until the bodies away from their owners, times this weight, exceed the ghosts: with few
        bodies and the usual weight that is in almost every step.
        """
        self.enter_context(mock.patch.object(replayed, "_MOST_AWAY", weight))


def graphs_on(device: torch.device | str) -> Graphs:
    """A context in which steps can be captured on this device; "none": without graphs."""
    stack = Graphs()
    if device != "none" and torch.device(device).type == "cpu":
        stack.enter_context(mock.patch.object(transaction, "capture", record))
        stack.enter_context(mock.patch.object(transaction, "record_event", lambda timed, sleep=False: Now()))
        stack.rounds = rounds = ConditionalRounds()
        stack.enter_context(mock.patch.object(rounds_module, "conditional", rounds.conditional))
        make_round = lambda attempt, *given: rounds.make_round(attempt, *given)  # noqa: E731  (a method)
        stack.enter_context(mock.patch.object(rounds_module.Attempt, "_make_round", make_round))
    return stack
