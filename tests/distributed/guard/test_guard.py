"""The guard names the right rank when a message does not arrive, and none otherwise."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from support.guards import TOKEN, Ranks, fail, ranks_of, verdict_of, wait_for

from pgccd.distributed import RankFailureError
from pgccd.distributed.guard import Guard, channel, guard, hub, turns
from pgccd.distributed.guard.channel import join


@pytest.fixture
def ranks(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ranks]:
    yield from ranks_of(3, monkeypatch)


@pytest.fixture
def incomplete(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ranks]:
    """Three ranks of four: the hub waits for the last one."""
    yield from ranks_of(4, monkeypatch)


@pytest.fixture
def exits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Exit codes with which the process would have ended."""
    codes: list[int] = []
    monkeypatch.setattr(guard.os, "_exit", codes.append)
    return codes


def test_no_rank_is_blamed_when_all_are_alive(ranks: Ranks, exits: list[int]) -> None:
    for one in ranks.guards:
        with one.waiting("first"):
            pass
    # All ranks compute for longer than the time-out; none is behind.
    time.sleep(2.0)
    assert exits == []
    for one in ranks.guards[1:]:
        with one.waiting("halo"):
            pass
    assert fail(ranks.guards[0]) == "connection closed by peer"
    # Before the time-out, a rank that has not reached an exchange is not late.
    for _ in range(3):
        with ranks.guards[1].waiting("halo"):
            pass
    assert fail(ranks.guards[1]) == "connection closed by peer"


def test_a_closed_connection_is_a_dead_rank(ranks: Ranks, exits: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    ranks.kill(1)
    ranks.guards[0].activity = "step 7"
    message = fail(ranks.guards[0])
    assert message.startswith("rank 1 (process 1) has died (rank 0 was in step 7, halo)")
    # Printed at once, by the hub only: launchers end all ranks soon.
    assert capsys.readouterr().err.count("pgccd: rank 1 (process 1) has died\n") == 1
    # A rank that gets no error is ended by its guard.
    said = ""

    def is_told() -> bool:
        nonlocal said
        said += capsys.readouterr().err
        return "rank 2 gives up in the start: rank 1 (process 1) has died" in said

    wait_for(is_told)
    assert set(exits) == {70}


def test_the_death_of_rank_0_is_seen_by_all(ranks: Ranks, exits: list[int]) -> None:
    ranks.hub._closing.set()
    ranks.hub._deadline = 0.0
    ranks.hub._ranks.clear()  # no message to the ranks
    ranks.thread_of_hub.join()
    for member in ranks.members.values():
        member.channel.socket.shutdown(socket.SHUT_RDWR)
    for one in ranks.guards[1:]:
        assert f"rank 0 (process {os.getpid()} on " in fail(one)
        assert "has died" in str(verdict_of(one))


def test_a_process_whose_gpu_waits_without_end_ends_at_once(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[0].is_broken = lambda: False
    ranks.guards[2].report(MemoryError("8 GiB"))
    for one in ranks.guards[:2]:
        assert "failed in the start" in fail(one)
    for one in ranks.guards[::-1]:
        one.close()
    del exits[:]
    for rank in range(3):
        ranks.end_process(rank)
    assert exits == [70]  # the exit code of the one with a GPU


def test_lost_messages_end_the_process_of_a_rank_that_gets_no_error(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[0].is_broken = lambda: True
    ranks.kill(1)
    wait_for(lambda: exits)
    assert verdict_of(ranks.guards[0]) == "rank 1 (process 1) has died"


def test_lost_messages_without_a_lost_rank(ranks: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_VERDICT_SECONDS", 2.0)
    ranks.guards[0].is_broken = lambda: True
    wait_for(lambda: exits)
    for one in ranks.guards:
        wait_for(lambda one=one: verdict_of(one))
        assert str(verdict_of(one)).endswith("lost messages of other ranks, although all are alive")


def test_a_message_that_does_not_arrive_although_all_ranks_have_sent_it(ranks: Ranks, exits: list[int]) -> None:
    for one in ranks.guards[1:]:
        with one.waiting("halo"):
            pass
    begin = time.monotonic()
    asking = ranks.guards[0]
    with asking.waiting("step"):
        ranks.connection(0).send(about="error", is_late=False, exchange=1)
        wait_for(asking._answered.is_set)
        assert asking._none_behind == (-1, 0)  # that question was not about the time
        wait_for(lambda: exits)
    assert time.monotonic() - begin > 2.0  # twice the time-out
    for one in ranks.guards:
        wait_for(lambda one=one: verdict_of(one))
        assert str(verdict_of(one)).endswith("lost messages of other ranks, although all are alive")


def test_a_long_exchange_that_waits_for_no_message_is_not_ended(ranks: Ranks, exits: list[int]) -> None:
    for one in ranks.guards:
        one.activity = "the last checkpoint"
        with one.waiting("checkpoint"):
            pass
    first, second, third = ranks.guards
    with contextlib.ExitStack() as stack:
        for one in (first, second, third):
            stack.enter_context(one.waiting("checkpoint", may_last=True))
        time.sleep(4.0)
    assert exits == [] and all(verdict_of(one) is None for one in ranks.guards)
    # The hub has been asked, but only once.
    assert ranks.guards[0]._none_behind == (2, 1)


def test_a_guard_without_a_hub_ends_the_process_hard_too(exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    at_exit: list[Callable[[], None]] = []
    monkeypatch.setattr(guard.atexit, "register", at_exit.append)
    alone = Guard()
    assert at_exit == []
    alone.end_hard()
    for function in at_exit:
        function()
    assert exits == [70]


def test_a_verdict_is_withdrawn_when_exchanges_go_on(
    ranks: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(guard, "_GRACE_SECONDS", 3.0)
    for turn in range(2):
        with ranks.guards[0].waiting("halo"), ranks.guards[1].waiting("halo"):
            wait_for(lambda: all(verdict_of(one) for one in ranks.guards))
            assert str(verdict_of(ranks.guards[1])).startswith("rank 2 (process 2) hangs in the start")
        with ranks.guards[2].waiting("halo"):
            pass
        wait_for(lambda: not any(verdict_of(one) for one in ranks.guards))
        assert verdict_of(ranks.hub) is None and exits == [], turn
    assert "goes on, and so does the job\n" in capsys.readouterr().err
    # What has ended cannot go on.
    ranks.kill(2)
    wait_for(lambda: verdict_of(ranks.guards[0]))
    ranks.connection(1).send(about="goes on")
    wait_for(lambda: exits)
    assert str(verdict_of(ranks.hub)) == "rank 2 (process 2) has died"


def test_only_a_second_look_without_progress_blames(ranks: Ranks, exits: list[int]) -> None:
    """A rank is behind at each look, but moves on."""
    stop = threading.Event()

    def is_slow() -> None:
        while not stop.wait(0.05):
            with ranks.guards[2].waiting("halo"):
                pass

    for one in ranks.guards[:2] * 500:
        with one.waiting("halo"):
            pass
    thread = threading.Thread(target=is_slow, daemon=True)
    thread.start()
    with ranks.guards[0].waiting("halo"), ranks.guards[1].waiting("halo"):
        try:
            wait_for(lambda: ranks.hub._queries > 3)
            assert exits == [] and verdict_of(ranks.hub) is None
        finally:
            stop.set()
            thread.join()
        wait_for(lambda: verdict_of(ranks.hub))
    assert "rank 2 (process 2) hangs" in str(verdict_of(ranks.hub))


def test_a_clock_of_turns_does_not_see_that_it_was_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(turns.time, "monotonic", lambda: now)
    clock = turns.TurnClock()
    for step in (0.2, 0.3, 1e6, 0.2, -1e6, 0.2):
        now += step
        clock.turn()
    assert 1.8 < clock.now < 2.0


def test_a_rank_that_is_behind_hangs(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[2].activity = "its user's loop"
    with ranks.guards[1].waiting("halo"):
        pass
    assert fail(ranks.guards[0], after=1.3).startswith("rank 2 (process 2) hangs in its user's loop (rank 0 was in")


def test_a_rank_that_waits_too_long_asks_by_itself(ranks: Ranks, exits: list[int]) -> None:
    with ranks.guards[0].waiting("halo"):  # longer than the time-out
        wait_for(lambda: exits)
    assert "hangs in the start" in str(verdict_of(ranks.guards[0]))


def test_a_rank_that_does_not_answer_is_blamed_last(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[2]._read_hub = lambda: time.sleep(0.1)  # type: ignore[method-assign]
    time.sleep(0.5)
    message = fail(ranks.guards[0], after=1.3)
    assert "rank 1 (process 1) hangs in the start" in message
    assert "rank 2 (process 2) does not answer: stopped, or busy" in message


def test_a_hub_that_does_not_answer_is_blamed(ranks: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_VERDICT_SECONDS", 1.0)
    monkeypatch.setattr(ranks.hub, "_ask_all", lambda *_: None)
    blamed = "does not answer: stopped, or busy"
    message = fail(ranks.guards[1])
    assert message.startswith(f"rank 0 (process {os.getpid()} on ") and blamed in message
    # Without an error, too.
    with ranks.guards[2].waiting("halo"):
        wait_for(lambda: verdict_of(ranks.guards[2]))
    assert blamed in str(verdict_of(ranks.guards[2]))
    # Rank 0 does not blame itself.
    assert fail(ranks.guards[0]) == "connection closed by peer"


def test_a_rank_that_failed_says_so(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[2].activity = "step 3"
    ranks.guards[2].report(MemoryError("8 GiB\nand a long story"))
    assert "rank 2 (process 2) failed in step 3: MemoryError: 8 GiB (rank 0" in fail(ranks.guards[0])
    # Failures that follow from it are not reported as separate causes; nor is a rank that gave up because of it at
    # fault.
    ranks.guards[1].report(RankFailureError("rank 2 failed"))
    ranks.guards[2].close()
    assert "rank 2 (process 2) failed" in fail(ranks.guards[1])


def test_a_rank_that_has_finished_is_missed_by_those_who_wait(ranks: Ranks, exits: list[int]) -> None:
    ranks.guards[1].close()
    assert fail(ranks.guards[2]).startswith("rank 1 has ended early")


def test_rank_0_may_finish_first(ranks: Ranks, exits: list[int]) -> None:
    begin = time.monotonic()
    ranks.guards[0].close()
    assert time.monotonic() - begin < 2.0
    time.sleep(1.0)
    assert exits == [] and verdict_of(ranks.guards[1]) is None
    assert fail(ranks.guards[1]).startswith("rank 0 has ended early")


def test_one_rank_alone_is_not_blamed() -> None:
    alone = Guard()
    assert fail(alone) == "connection closed by peer"
    alone.report(ValueError("mine"))
    alone.close()


def lines_of_strangers() -> list[bytes]:
    lies = json.dumps({"about": "failure", "text": "a lie"}).encode() + b"\n"
    who = {"rank": 1, "name": "process 1"}
    unproven = json.dumps({"who": who, "nonce": "0", "proof": secrets.token_hex(32)}).encode() + b"\n"
    deep = [
        json.dumps({"nonce": "0", "proof": "0"})[:-1].encode() + b', "who": {"rank": 3, "a": ' + depth + b"}}\n"
        for depth in (b"[" * count + b"]" * count for count in (100, 300, 900, 990, 1100, 20_000))
    ]
    values = ["\u00e9", "\ud800", 1e999, None, [], {}, -1, True, "x" * 60_000]
    odd = [json.dumps({"who": who, "nonce": value, "proof": value}).encode() + b"\n" for value in values]
    odd += [json.dumps({"who": {"rank": value}, "nonce": "0", "proof": "0"}).encode() + b"\n" for value in values]
    nonsense = [b"\xff" * 200_000, b"[" * 60_000 + b"\n", b"null\n", b'{"who": 3}\n', b"\n", b"", b"9" * 5000 + b"\n"]
    return [lies, unproven + lies, *nonsense, *deep, *odd]


def test_strangers_are_not_believed(incomplete: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    ranks = incomplete
    address = ("127.0.0.1", ranks.hub.port)
    with pytest.raises(RuntimeError, match="^guard: no connection to rank 0 at 127.0.0.1:.*does not accept this rank"):
        ranks.channel(3, token=b"a guess")
    for bytes_ in lines_of_strangers():
        with socket.create_connection(address) as stranger:
            stranger.settimeout(10.0)
            try:
                stranger.sendall(bytes_)
                if bytes_:  # the hub sends its nonce and that it refuses, and nothing else
                    assert sum(len(part) for part in iter(lambda: stranger.recv(4096), b"")) < 100  # noqa: B023
            except ConnectionError:
                pass
    # A second connection of a connected rank is rejected, even with the token; so is a rank that there is not.
    for rank in (1, 4, -1):
        with pytest.raises(RuntimeError, match="does not accept this rank"):
            ranks.channel(rank)
    monkeypatch.setattr(hub, "_GREETING_SECONDS", 0.1)
    with socket.create_connection(address) as silent:
        silent.settimeout(10.0)
        while silent.recv(4096):
            pass
    assert ranks.thread_of_hub.is_alive() and not ranks.hub.is_complete.is_set()
    assert (
        fail(ranks.guards[0]) != ""
        and verdict_of(ranks.guards[1]) is None
        or "hangs" in str(verdict_of(ranks.guards[1]))
    )
    assert "lie" not in str([verdict_of(one) for one in ranks.guards])
    last = ranks.channel(3)
    assert ranks.hub.is_complete.wait(5.0)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(address, timeout=5.0)
    last.close()


def test_a_flood_of_connections(incomplete: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A bounded number of them is open at a time, and a rank can still join."""
    monkeypatch.setattr(hub, "_MOST_GREETINGS", 8)
    address, most, stop = ("127.0.0.1", incomplete.hub.port), 0, threading.Event()

    def flood() -> None:
        opened = []
        while not stop.is_set():
            with contextlib.suppress(OSError):
                opened.append(socket.create_connection(address, timeout=1.0))
            if len(opened) > 200:
                opened.pop(0).close()
        for one in opened:
            one.close()

    threads = [threading.Thread(target=flood) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(50):
        time.sleep(0.02)
        most = max(most, len(incomplete.hub._greetings))
    try:
        channel_of_last = join(address, TOKEN, {"rank": 3, "name": "late"}, 30.0)
        assert incomplete.hub.is_complete.wait(5.0)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert 0 < most <= 8 + 4
    assert incomplete.hub._greetings == {} and exits == []
    channel_of_last.close()


def test_half_greetings_do_not_keep_ranks_out(
    incomplete: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each stranger sends a part of a line, or all that is allowed of one, and stays."""
    monkeypatch.setattr(hub, "_MOST_GREETINGS", 8)
    address, strangers = ("127.0.0.1", incomplete.hub.port), []
    for k in range(60):
        one = socket.create_connection(address, timeout=5.0)
        with contextlib.suppress(OSError):
            one.sendall([b'{"who": {"rank": 3', b"{", b"x" * 60_000, '{"who"'.encode("utf-16")][k % 4])
        strangers.append(one)
    last = join(address, TOKEN, {"rank": 3, "name": "late"}, 20.0)
    assert incomplete.hub.is_complete.wait(5.0) and incomplete.thread_of_hub.is_alive() and exits == []
    for one in [*strangers, last]:
        one.close()


def test_a_rank_connects_again_if_the_hub_cannot_accept_it(
    incomplete: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hub does not count a rank whose connection it has closed."""
    note, errors = incomplete.hub._note_address, [OSError("the first connection is reset")]

    def fail_once(its_channel: channel.Channel) -> None:
        if errors:
            raise errors.pop()
        note(its_channel)

    monkeypatch.setattr(incomplete.hub, "_note_address", fail_once)
    last = join(("127.0.0.1", incomplete.hub.port), TOKEN, {"rank": 3, "name": "late"}, 20.0)
    assert incomplete.hub.is_complete.wait(5.0) and not errors and exits == []
    last.close()


def test_a_greeting_counts_once(incomplete: Ranks, exits: list[int]) -> None:
    """What a rank has sent, and what the hub itself sends, are no proof on another connection."""
    recorded: list[bytes] = []

    def relay(listener: socket.socket) -> None:
        """A stranger between a rank and the hub, who records what the rank sends."""
        with (
            listener.accept()[0] as rank,
            socket.create_connection(("127.0.0.1", incomplete.hub.port)) as to_hub,
        ):
            rank.sendall(to_hub.recv(4096))
            recorded.append(rank.recv(65536))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=relay, args=(listener,))
        thread.start()
        with pytest.raises(RuntimeError, match="^guard: no connection"):
            join(listener.getsockname(), TOKEN, {"rank": 3, "name": "late"}, 1.0)
        thread.join()
    assert b'"rank": 3' in recorded[0] and TOKEN not in recorded[0]
    for reflects in (False, True):
        with socket.create_connection(("127.0.0.1", incomplete.hub.port), timeout=5.0) as stranger:
            nonce = json.loads(stranger.recv(4096))["nonce"]
            sent = json.loads(recorded[0]) | ({"nonce": nonce} if reflects else {})
            stranger.sendall(json.dumps(sent).encode() + b"\n")
            assert json.loads(stranger.recv(4096)) == {"refused": True}
    assert incomplete.hub.missing() == [3] and exits == []


def test_a_hub_that_may_open_no_more_files(
    incomplete: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = iter([True] * 5)
    accept = socket.socket.accept

    def without_files(listener: socket.socket) -> object:
        if next(failing, False):
            raise OSError(24, "Too many open files")
        return accept(listener)

    monkeypatch.setattr(socket.socket, "accept", without_files)
    incomplete.channel(3).close()
    assert next(failing, None) is None


def test_a_hub_that_fails_blames_nobody(
    ranks: Ranks, exits: list[int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise MemoryError("8 GiB")

    wait_for(ranks.hub.is_complete.is_set)  # an error while ranks join ends their connection, not the hub
    monkeypatch.setattr(ranks.hub, "_drop_strangers", fails)
    ranks.thread_of_hub.join(5.0)
    said = "the hub of the guard, on rank 0, has failed (MemoryError: 8 GiB)"
    assert f"pgccd: {said}" in capsys.readouterr().err
    time.sleep(1.0)  # longer than the grace period
    assert exits == [] and all(verdict_of(one) is None for one in ranks.guards)
    # Only a message that does not arrive ends the job.
    with ranks.guards[1].waiting("halo"):
        wait_for(lambda: exits)
    assert verdict_of(ranks.guards[1]) == f"a message has not arrived, and {said}"
    assert "has died" not in capsys.readouterr().err


def test_a_guard_whose_thread_meets_an_error_goes_on(
    ranks: Ranks, exits: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    def fails() -> bool:
        raise RuntimeError("the group has been destroyed")

    ranks.guards[1].is_broken = fails
    time.sleep(1.0)
    assert capsys.readouterr().err.count("pgccd: the guard of rank 1 has failed (RuntimeError: the group") == 1
    ranks.guards[2].activity = "its user's loop"
    with ranks.guards[1].waiting("halo"), ranks.guards[0].waiting("halo"):
        wait_for(lambda: exits)
    assert verdict_of(ranks.guards[0]) == "rank 2 (process 2) hangs in its user's loop"


def test_ranks_do_not_believe_a_hub_without_the_token() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()

        def answer() -> None:
            end = channel.Channel(server.accept()[0])
            end.send(nonce="1")
            end.receive(5.0)
            end.send(proof="0", name="process 0")

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(RuntimeError, match="does not belong to this job$"):
            join(address, TOKEN, {"rank": 1}, 5.0)
        thread.join()


def test_a_changed_line_ends_the_job(ranks: Ranks, exits: list[int]) -> None:
    ranks.connection(2).socket.sendall(b'{"about": "failure", "text": "failed"}\n')
    assert fail(ranks.guards[1]).startswith("rank 2 (process 2) is lost: its connection carries lines that it has not")


def test_a_line_that_rank_0_has_not_sent(ranks: Ranks, exits: list[int]) -> None:
    ranks.members[2].channel.socket.sendall(b'{"about": "verdict", "text": "rank 7 has died", "is_final": true}\n')
    assert fail(ranks.guards[2]).startswith("the connection to rank 0 carries lines that rank 0 has not sent")


def test_a_verdict_is_one_printable_line(ranks: Ranks, exits: list[int], capfd: pytest.CaptureFixture[str]) -> None:
    text = "failed\n\x1b[31mpgccd: rank 0 has died\u2028" + 5000 * "x"
    ranks.connection(2).send(about="failure", text=text)
    wait_for(lambda: verdict_of(ranks.guards[1]) is not None)
    verdict = str(verdict_of(ranks.guards[1]))
    assert verdict.isprintable() and r"failed\n\x1b[31mpgccd" in verdict and len(verdict) <= 2000
    assert all(line.isprintable() for line in capfd.readouterr().err.split("\n"))
