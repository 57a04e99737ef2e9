"""A rank's part of the guard: around every exchange, and in a thread that answers the hub."""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from pgccd.distributed.guard.channel import Channel
from pgccd.distributed.guard.hub import Hub

_TICK_SECONDS = 1.0
# The hub's verdict comes by then, if there is one.
_VERDICT_SECONDS = 15.0
# What a rank whose exchange cannot end any more is granted for ending it by itself.
_GRACE_SECONDS = 10.0
_EXIT_CODE = 70
# An error after so large a part of the time-out is one: libraries have clocks of their own.
_LATE = 0.9


class RankFailureError(RuntimeError):
    """Another rank died, hangs or failed; the message names it."""


E = TypeVar("E", bound=BaseException)


def of_all_ranks(error: E) -> E:
    """Marks an error that all ranks raise together."""
    error.of_all_ranks = True  # type: ignore[attr-defined]
    return error


def is_of_all_ranks(error: BaseException | None) -> bool:
    """Whether all ranks have this error, or what caused it, so that none need tell the others."""
    while error is not None:
        if getattr(error, "of_all_ranks", False):
            return True
        error = error.__cause__
    return False


class Guard:
    """Watches the exchanges of this rank, and ends them if they cannot end by themselves.

    Args:
        channel: to the hub; None: without others to watch, errors pass as they are.
        rank: this one.
        timeout: seconds after which an exchange that does not end means that some rank hangs.
        hub: on rank 0.

    Example:
        >>> with guard.waiting("halo"):
        ...     work.wait()
    """

    def __init__(
        self, channel: Channel | None = None, rank: int = 0, timeout: float = 300.0, hub: Hub | None = None
    ) -> None:
        self._channel, self._rank, self._timeout, self._hub = channel, rank, timeout, hub
        self._lock = threading.Lock()
        self._exchanges, self._is_waiting = 0, False
        self._progress = time.monotonic()
        #: What the rank is about, for messages: set it as often as you like.
        self.activity = "the start"
        #: Whether what carries the messages has noticed that some are lost. Given if it lets a GPU wait for messages
        #: that never come: the process would wait for the GPU, then, even at its end.
        self.is_broken: Callable[[], bool] | None = None
        self._ends_hard = False
        self._closed = threading.Event()
        self._verdict: str | None = None
        # Set by a verdict, and by the hub's answer that there is none.
        self._answered = threading.Event()
        # Of the thread.
        self._ended_hub: str | None = None
        self._is_alone = False
        self._late_at = -1
        self._broken_since: float | None = None
        # torchrun's agent, whose end nothing else tells its ranks. Other launchers end theirs; and a shell that started
        # ranks in the background may go.
        self._agent = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        if channel is not None:
            self._thread = threading.Thread(target=self._watch, name="pgccd-guard", daemon=True)
            self._thread.start()
            # Where nobody closes the guard, the end of the process does.
            atexit.register(self._leave)

    @contextmanager
    def waiting(self, what: str) -> Iterator[None]:
        """Around every exchange. An error in it becomes a `RankFailureError` if another rank is to blame."""
        with self._lock:
            self._exchanges += 1
            self._progress = time.monotonic()
            self._is_waiting = True
        try:
            yield
        except RuntimeError as error:
            verdict = self._ask(time.monotonic() - self._progress > _LATE * self._timeout)
            if verdict is None:
                raise
            self._ends_hard = self.is_broken is not None
            raise RankFailureError(f"{verdict} (rank {self._rank} was in {self.activity}, {what})") from error
        finally:
            self._is_waiting = False

    def report(self, error: BaseException) -> None:
        """Reports to all ranks that this one ends with an error of its own."""
        if self._channel is None or isinstance(error, RankFailureError):
            return
        first_line = f"{type(error).__name__}: {error}".splitlines()[0][:1000]
        self._channel.send(about="failure", text=f"failed in {self.activity}: {first_line}")

    def close(self) -> None:
        """Leaves the others: a rank that has finished is not missed, unless another waits for it."""
        if self._closed.is_set() or self._channel is None:
            return
        self._closed.set()
        self._channel.send(about="finished")
        self._thread.join(_GRACE_SECONDS)
        self.is_broken = None  # which holds what must go before Python does
        self._channel.close()
        if self._hub is not None:
            self._hub.close(2.0 * _GRACE_SECONDS)  # others may have to read its verdict yet

    def _leave(self) -> None:
        """At the end of the process, when errors have been printed."""
        self.close()
        if self._ends_hard:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(_EXIT_CODE)

    def _ask(self, is_late: bool) -> str | None:
        """Which rank made an exchange fail, in words; None if all others are alive and, if it is late, not behind."""
        if self._channel is None:
            return None
        self._answered.clear()
        if self._verdict is None:
            if self._channel.send(about="error", is_late=is_late):
                self._answered.wait(_VERDICT_SECONDS)
            else:
                self._answered.wait(_TICK_SECONDS)  # until the thread has noticed it too
        return self._verdict or self._ended_hub

    def _watch(self) -> None:
        """The thread: answers the hub, and ends the process if its main thread waits for what can never come.

        Libraries differ in what they do about a lost rank: Gloo raises an error at once, NCCL never returns.
        """
        hopeless_since: float | None = None
        while not self._closed.is_set():
            self._read_hub()
            if self._verdict is None:
                self._look_at_this_rank()
                continue
            hopeless_since = hopeless_since or time.monotonic()
            if time.monotonic() - hopeless_since > _GRACE_SECONDS and not self._closed.is_set():
                self._give_up()

    def _look_at_this_rank(self) -> None:
        """Asks the hub if an exchange takes too long, or messages were lost."""
        assert self._channel is not None
        with self._lock:
            exchanges, still = self._exchanges, time.monotonic() - self._progress
        is_late = still > self._timeout
        if self._agent is not None and os.getppid() != self._agent:
            self._fail("has lost the process that launched it")
        elif is_late and self._is_waiting and self._ended_hub is not None:
            self._decide(self._ended_hub)
        elif is_late and self._late_at != exchanges:
            self._late_at = exchanges
            self._channel.send(about="error", is_late=True)
        elif self.is_broken is not None and self.is_broken():
            if self._broken_since is None:
                self._broken_since = time.monotonic()
                self._channel.send(about="error", is_late=False)
            elif time.monotonic() - self._broken_since > _VERDICT_SECONDS:
                self._fail("lost messages of other ranks, though all are alive")

    def _fail(self, text: str) -> None:
        assert self._channel is not None
        self._channel.send(about="failure", text=text)
        self._decide(f"rank {self._rank} {text}")

    def _read_hub(self) -> None:
        """What the hub says within a fraction of a second."""
        assert self._channel is not None
        messages = None if self._is_alone else self._channel.receive(0.2 * _TICK_SECONDS)
        if messages is None:
            if not self._is_alone and self._ended_hub is None and not self._closed.is_set():
                self._decide(f"rank 0 ({self._channel.peer}) has died")
            self._is_alone = True
            self._closed.wait(0.2 * _TICK_SECONDS)
        for message in messages or []:
            match message.get("about"):
                case "verdict":
                    self._decide(str(message.get("text")))
                case "no verdict":
                    self._answered.set()
                case "closing":
                    self._ended_hub = "rank 0 has ended early"
                case "question":
                    with self._lock:
                        exchanges = self._exchanges
                    here = {"exchanges": exchanges, "activity": self.activity}
                    self._channel.send(about="answer", number=message.get("number"), **here)

    def _decide(self, verdict: str) -> None:
        self._verdict = self._verdict or verdict
        self._answered.set()

    def _give_up(self) -> None:
        sys.stderr.write(f"pgccd: rank {self._rank} gives up in {self.activity}: {self._verdict}\n")
        sys.stderr.flush()
        os._exit(_EXIT_CODE)  # nothing gentler ends a call into a communication library
