"""Stage times of a step: host clock on a CPU, events on a GPU, read only on request."""

from __future__ import annotations

import time

import pytest
import torch

from pgccd.runtime.stages import StageClock


class Event:
    """Replaces an event on a GPU stream; one second after the one before."""

    made: list[Event] = []

    def __init__(self, enable_timing: bool, blocking: bool) -> None:
        assert enable_timing
        self.at, self.waited_for = -1.0, False

    def record(self, stream: str) -> None:
        assert stream == "stream of 3"
        Event.made.append(self)
        self.at = float(len(Event.made))

    def synchronize(self) -> None:
        self.waited_for = True

    def elapsed_time(self, later: Event) -> float:
        assert later.waited_for
        return 1e3 * (later.at - self.at)


def test_stages_add_up_on_the_host() -> None:
    clock = StageClock()
    for _ in range(2):
        with clock.stage("plan"):
            time.sleep(0.01)
    with clock.stage("gather"):
        pass
    clock.add({"narrow": 1.0})
    assert list(clock.seconds) == ["plan", "gather", "narrow"]
    assert 0.02 <= clock.seconds["plan"] <= clock.total
    assert clock.work == clock.seconds["plan"] + 1.0


def test_on_a_gpu_events_tell_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    Event.made = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 3)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: f"stream of {device}")
    clock = StageClock()
    with clock.stage("plan"), clock.stage("gather"):
        pass
    with clock.stage("plan"):
        pass
    assert not any(event.waited_for for event in Event.made)
    assert clock.work == 4.0  # of the plan only: from event 1 to 4 and from event 5 to 6
    assert not Event.made[2].waited_for
    assert clock.seconds == {"plan": 4.0, "gather": 1.0} == clock.seconds
