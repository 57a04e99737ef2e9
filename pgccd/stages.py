"""Where the time of a step goes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch

_WORK = ("plan", "bounds", "broad", "traverse", "narrow")


class StageClock:
    """Seconds by stage, and since the clock was made.

    Example:
        >>> clock = StageClock()
        >>> with clock.stage("plan"):
        ...     state = world.plan(state, step)
    """

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time of the block to a stage."""
        start = time.perf_counter()
        yield
        # Work still queued on a GPU belongs to the stage that queued it; most stages wait for results anyway.
        if torch.cuda.is_initialized():
            torch.cuda.current_stream().synchronize()
        self.add({name: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Adds times measured by others."""
        for name, spent in seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + spent

    @property
    def work(self) -> float:
        """Seconds in stages in which a rank never waits for another."""
        return sum(self.seconds.get(stage, 0.0) for stage in _WORK)

    @property
    def total(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._start
