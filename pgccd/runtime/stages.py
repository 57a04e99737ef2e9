"""Times of the stages of a step."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import torch

from pgccd.runtime.events import record_event

_WORK = ("plan", "bounds", "broad", "traverse", "narrow")


class _Stage:
    """A block that is timed. A class, since `contextmanager` makes twice as many calls."""

    def __init__(self, clock: StageClock, name: str) -> None:
        self._clock, self._name = clock, name

    def __enter__(self) -> None:
        self._clock._seconds.setdefault(self._name, 0.0)  # lists stages in the order in which they began
        self._began = record_event(timed=True) if torch.cuda.is_initialized() else time.perf_counter()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            return
        if isinstance(self._began, float):
            self._clock._seconds[self._name] += time.perf_counter() - self._began
        else:
            self._clock._events.append((self._name, self._began, record_event(timed=True)))


class StageClock:
    """Seconds per stage, and in total.

    On a GPU a stage is timed by events on the stream, without synchronising; the times are read on access.

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
        """A stopped clock with given times."""
        clock = cls()
        clock.add(seconds)
        clock._total = total
        return clock

    def stage(self, name: str) -> _Stage:
        """Adds the time of the block to a stage."""
        return _Stage(self, name)

    def add(self, seconds: Mapping[str, float]) -> None:
        """Adds times measured elsewhere."""
        for name, spent in seconds.items():
            self._seconds[name] = self._seconds.get(name, 0.0) + spent

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage. Waits for the end of the last one."""
        self._read([name for name, _, _ in self._events])
        return self._seconds

    @property
    def work(self) -> float:
        """Seconds in stages in which a rank does not wait for others."""
        self._read(_WORK)
        return sum(self._seconds.get(stage, 0.0) for stage in _WORK)

    def stop(self) -> None:
        """Stops `total`."""
        self._total = self.total

    @property
    def total(self) -> float:
        """Seconds since the clock was made, until it was stopped."""
        return time.perf_counter() - self._start if self._total is None else self._total

    def _read(self, names: Sequence[str]) -> None:
        pending, self._events = self._events, []
        for name, begin, end in pending:
            if name in names:
                end.synchronize()
                self.add({name: 1e-3 * begin.elapsed_time(end)})
            else:
                self._events.append((name, begin, end))
