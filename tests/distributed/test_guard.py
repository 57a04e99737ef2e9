"""Which rank the guard names when a message does not come, and that it names none otherwise."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import torch.distributed as dist

from pgccd.distributed import RankFailureError, guard
from pgccd.distributed.guard import Guard


@pytest.fixture
def guards(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Guard]]:
    """Three ranks in one process, whose pulses are fast."""
    monkeypatch.setattr(guard, "_PULSE_SECONDS", 0.02)
    monkeypatch.setattr(guard, "_SILENCE_SECONDS", 1.2)  # threads of a busy machine may stand still for a while
    monkeypatch.setattr(guard, "_SUSPICION_SECONDS", 0.1)
    monkeypatch.setattr(guard, "_GRACE_SECONDS", 0.5)
    store = dist.HashStore()
    ranks = [Guard(store, rank, 3, timeout=2.0) for rank in range(3)]
    yield ranks
    for rank in ranks:
        rank.close()
        rank._ends_hard = False  # or the tests would end as a rank does that failed


def fail(rank: Guard) -> str:
    with pytest.raises(RuntimeError) as caught, rank.waiting("halo"):
        raise RuntimeError("connection closed by peer")
    return str(caught.value)


@pytest.fixture
def exits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Codes with which the process would have been ended."""
    codes: list[int] = []
    monkeypatch.setattr(guard.os, "_exit", codes.append)
    return codes


def test_no_rank_is_blamed_when_all_are_alive(guards: list[Guard], exits: list[int]) -> None:
    for rank in guards:
        with rank.waiting("first"):
            pass
    # All compute for longer than the time-out; no rank is behind.
    time.sleep(3.0)
    assert exits == []
    for rank in guards[1:]:
        with rank.waiting("halo"):
            pass
    assert fail(guards[0]) == "connection closed by peer"


def test_a_silent_rank_has_died(guards: list[Guard], exits: list[int]) -> None:
    guards[1]._closed.set()  # its thread stops, as when the process is killed
    guards[1]._thread.join()
    guards[0].activity = "step 7"
    message = fail(guards[0])
    assert message.startswith("rank 1 (process ") and "has died (rank 0 was in step 7, halo)" in message
    # A rank that gets no error is ended by its guard.
    assert _failure_told(guards[2], exits).startswith("rank 1 (process ")
    guards[1]._closed.clear()


def test_a_process_whose_gpu_waits_without_end_ends_at_once(guards: list[Guard], exits: list[int]) -> None:
    guards[0].is_broken = lambda: False
    guards[2].report(MemoryError("8 GiB"))
    for rank in guards[:2]:
        assert "failed in the start" in fail(rank)
    for rank in guards:
        rank.close()
    del exits[:]
    for rank in guards:
        rank._leave()
    assert exits == [70]  # of the one with a GPU


def test_lost_messages_end_the_process_of_a_rank_that_gets_no_error(guards: list[Guard], exits: list[int]) -> None:
    guards[1]._closed.set()
    guards[1]._thread.join()
    guards[0].is_broken = lambda: True
    assert _failure_told(guards[0], exits).startswith("rank 1 (process ")
    guards[1]._closed.clear()


def test_lost_messages_without_a_lost_rank(guards: list[Guard], exits: list[int]) -> None:
    guards[0].is_broken = lambda: True
    assert _failure_told(guards[0], exits) == "messages between ranks were lost, though all are alive"


def _failure_told(rank: Guard, exits: list[int]) -> str:
    """What all ranks report when one gives up."""
    deadline = time.monotonic() + 20.0
    while not exits and time.monotonic() < deadline:
        time.sleep(0.05)
    assert exits and set(exits) == {70}
    return rank._store.get("failure").decode()


def test_a_rank_that_is_behind_hangs(guards: list[Guard], exits: list[int]) -> None:
    guards[2].activity = "its user's loop"
    with guards[1].waiting("halo"):
        pass
    message = fail(guards[0])
    assert message.startswith("rank 2 (process ") and "hangs in its user's loop" in message


def test_a_rank_that_failed_says_so(guards: list[Guard], exits: list[int]) -> None:
    guards[2].activity = "step 3"
    guards[2].report(MemoryError("8 GiB\nand a long story"))
    assert "failed in step 3: MemoryError: 8 GiB (rank 0" in fail(guards[0])
    # What follows from that is not reported as a cause of its own; nor is a rank blamed that gave up because of it.
    guards[0].close()
    guards[1].report(RankFailureError("rank 2 failed"))
    assert "rank 2 (process" in fail(guards[0])


def test_a_rank_that_has_finished_is_missed_by_those_who_wait(guards: list[Guard], exits: list[int]) -> None:
    guards[1].close()
    assert fail(guards[0]).startswith("rank 1 has ended early")


def test_one_rank_alone_is_not_blamed() -> None:
    alone = Guard()
    assert fail(alone) == "connection closed by peer"
    alone.report(ValueError("mine"))
    alone.close()
