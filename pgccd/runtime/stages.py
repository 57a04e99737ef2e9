"""Where the time of a step goes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch

from pgccd.runtime.events import record_event

_WORK = ("plan", "bounds", "broad", "traverse", "narrow")


class StageClock:
    """Seconds by stage, and since the clock was made.

    On a GPU a stage lasts from event to event on the stream, so that taking the time keeps nothing waiting; the times
    are read when they are asked for.

    Example:
        >>> clock = StageClock()
        >>> with clock.stage("plan"):
        ...     state = model.plan(state, step)
    """

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._total: float | None = None
        self._seconds: dict[str, float] = {}
        self._events: list[tuple[str, torch.cuda.Event, torch.cuda.Event]] = []

    @classmethod
    def of(cls, seconds: Mapping[str, float], total: float) -> StageClock:
        """A clock that was stopped, of times measured by others."""
        clock = cls()
        clock.add(seconds)
        clock._total = total
        return clock

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time of the block to a stage."""
        self.add({name: 0.0})  # stages are listed in the order in which they began
        if torch.cuda.is_initialized():
            begin = record_event(timed=True)
            yield
            self._events.append((name, begin, record_event(timed=True)))
        else:
            start = time.perf_counter()
            yield
            self.add({name: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Adds times measured by others."""
        for name, spent in seconds.items():
            self._seconds[name] = self._seconds.get(name, 0.0) + spent

    @property
    def seconds(self) -> dict[str, float]:
        """By stage. Waits until the last of them is over."""
        self._read([name for name, _, _ in self._events])
        return self._seconds

    @property
    def work(self) -> float:
        """Seconds in stages in which a rank never waits for another."""
        self._read(_WORK)
        return sum(self._seconds.get(stage, 0.0) for stage in _WORK)

    def restart(self) -> None:
        """`total` counts from now on. Stages that are over stay as they are."""
        self._start = time.perf_counter()

    def stop(self) -> None:
        """Ends the time that `total` returns."""
        self._total = self.total

    @property
    def total(self) -> float:
        """Seconds since the clock was made or restarted, until it was stopped."""
        return time.perf_counter() - self._start if self._total is None else self._total

    def _read(self, names: Sequence[str]) -> None:
        pending, self._events = self._events, []
        for name, begin, end in pending:
            if name in names:
                end.synchronize()
                self.add({name: 1e-3 * begin.elapsed_time(end)})
            else:
                self._events.append((name, begin, end))
