"""The hub compares the public calls of ranks."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

import pytest
from support.guards import Ranks, ranks_of, verdict_of, wait_for

from pgccd.distributed import RankFailureError
from pgccd.distributed.guard import guard


@pytest.fixture
def ranks(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ranks]:
    yield from ranks_of(3, monkeypatch)


@pytest.fixture
def exits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Exit codes with which the process would have ended."""
    codes: list[int] = []
    monkeypatch.setattr(guard.os, "_exit", codes.append)
    return codes


def test_calls_are_compared(ranks: Ranks, exits: list[int]) -> None:
    first, second, third = ranks.guards
    for name in ("make", "turn"):  # slow ranks are not at fault
        for one in ranks.guards:
            assert one.begin_call(name)
            assert not one.begin_call("within it")
            one.end_call()
    wait_for(lambda: ranks.members[2].calls == 2)
    assert ranks.hub._calls == {} and verdict_of(ranks.hub) is None
    third.begin_call("turn")
    wait_for(lambda: ranks.members[2].calls == 3)
    assert verdict_of(ranks.hub) is None
    second.begin_call("make")
    text = "rank 1 (process 1) calls make where rank 2 (process 2) calls turn (call 3)"
    for one in ranks.guards:
        wait_for(lambda one=one: verdict_of(one))
        assert verdict_of(one) == text
    with pytest.raises(RankFailureError, match="about to call turn"):
        first.begin_call("turn")
    with pytest.raises(RankFailureError, match="calls make where"), second.waiting("a message"):
        second.require_no_verdict()


def test_an_error_in_a_call_is_settled_when_no_rank_is_in_it(ranks: Ranks, exits: list[int]) -> None:
    first, second, third = ranks.guards
    for one in ranks.guards:
        one.begin_call("turn")
    second.fail_call(ValueError("of one"))
    second.end_call()
    first.fail_call(ValueError("of another"))
    assert first._has_failed_call and not first._settled.is_set()
    third.end_call()  # it has made the call
    third.begin_call("next")
    third.end_call()
    second.begin_call("next")  # waits until this is known
    assert second._settled.is_set() and not second._has_failed_call and ranks.hub._failed_calls == {}
    assert verdict_of(ranks.hub) is None


def test_a_rank_waits_in_a_call_that_another_has_left(ranks: Ranks, exits: list[int]) -> None:
    first, second, third = ranks.guards
    for one in ranks.guards:
        one.begin_call("turn")
    with third.waiting("halo"):
        second.fail_call(ValueError("of one"))
        second.end_call()
        with pytest.raises(RankFailureError, match=r"rank 1 \(process 1\) failed in turn: ValueError: of one"):
            second.begin_call("next")
    with pytest.raises(RankFailureError, match="failed in turn"):
        first.fail_call(ValueError("that follows"))


def test_a_rank_that_has_finished_is_missed_by_a_call(ranks: Ranks, exits: list[int]) -> None:
    for one in ranks.guards:
        one.begin_call("turn")
        one.end_call()
    ranks.guards[2].close()
    wait_for(lambda: ranks.members[2].finished)
    assert verdict_of(ranks.hub) is None
    ranks.guards[1].begin_call("next")
    wait_for(lambda: verdict_of(ranks.hub))
    expected = "rank 2 has ended early, after 1 calls, where rank 1 (process 1) calls next (call 2)"
    assert verdict_of(ranks.hub) == expected


def test_stacks_are_printed_if_ranks_hang(ranks: Ranks, exits: list[int], capfd: pytest.CaptureFixture[str]) -> None:
    for one in ranks.guards:
        one.activity = "a loop"
    with ranks.guards[0].waiting("halo"), ranks.guards[1].waiting("halo"):
        wait_for(lambda: verdict_of(ranks.guards[2]))
        said = ""

        def is_told() -> bool:
            nonlocal said
            said += capfd.readouterr().err
            return all(f"pgccd: rank {rank} is in a loop:" in said for rank in range(3))

        wait_for(is_told)
    assert "test_stacks_are_printed_if_ranks_hang" in said and "rank 2 (process 2) hangs in a loop" in said


def test_the_error_that_ends_a_program_is_told(ranks: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard.sys, "last_value", KeyError("of the user"), raising=False)
    ranks.end_process(1)
    wait_for(lambda: verdict_of(ranks.hub))
    assert verdict_of(ranks.hub) == "rank 1 (process 1) failed in the start: KeyError: 'of the user'"


def test_the_verdict_is_printed_last(ranks: Ranks, exits: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    ranks.kill(1)
    wait_for(lambda: verdict_of(ranks.guards[0]))
    for one in ranks.guards[::-1]:
        one.close()
    sys.stderr.write("a traceback\n")
    ranks.end_process(0)
    assert capsys.readouterr().err.splitlines()[-2:] == ["a traceback", "pgccd: rank 1 (process 1) has died"]


def test_two_threads_cannot_call_at_the_same_time(ranks: Ranks, exits: list[int]) -> None:
    first = ranks.guards[0]
    first.begin_call("turn")
    problems: list[str] = []

    def call() -> None:
        try:
            first.begin_call("next")
        except RuntimeError as error:
            problems.append(str(error))

    for _ in range(2):
        thread = threading.Thread(target=call)
        thread.start()
        thread.join()
        first.end_call()
    assert problems == ["next: another thread of rank 0 is in such a call"] and first._calls == 2
