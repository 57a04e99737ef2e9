"""A rank's side of the guard: wraps every exchange, and answers the hub from a thread."""

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
# Duration of a turn of the thread.
_TURN_SECONDS = 0.2
# Maximum time to wait for the hub's verdict.
_VERDICT_SECONDS = 15.0
# Time for a rank to end a failed exchange by itself before the process is killed.
_GRACE_SECONDS = 10.0
_EXIT_CODE = 70
# An error after this fraction of the time-out counts as a time-out, since libraries measure time differently.
_LATE = 0.9


class RankFailureError(RuntimeError):
    """Another rank died, hangs or failed; the message names it."""


E = TypeVar("E", bound=BaseException)


def of_all_ranks(error: E) -> E:
    """Marks an error that is raised on all ranks."""
    error.of_all_ranks = True  # type: ignore[attr-defined]
    return error


def is_of_all_ranks(error: BaseException | None) -> bool:
    """Whether this error or its cause is raised on all ranks, so that it need not be reported."""
    while error is not None:
        if getattr(error, "of_all_ranks", False):
            return True
        error = error.__cause__
    return False


class Guard:
    """Watches the exchanges of this rank, and ends the process if they cannot complete.

    Args:
        channel: to the hub; None: errors are passed on unchanged.
        rank: of this process.
        timeout: seconds after which a pending exchange means that a rank hangs.
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
        self._exchanges, self._is_waiting, self._is_for_gpu = 0, False, False
        self._progress = time.monotonic()
        #: Current activity of the rank, for messages; cheap to set.
        self.activity = "the start"
        #: Whether the communication library has recorded lost messages. Set for NCCL, where a GPU waits for such
        #: messages forever, and the process for the GPU, even at exit.
        self.is_broken: Callable[[], bool] | None = None
        self._ends_hard = False
        self._closed = threading.Event()
        self._verdict: str | None = None
        # Set by a verdict, and by the hub's answer that there is none.
        self._answered = threading.Event()
        # Used only by the thread.
        self._ended_hub: str | None = None
        self._is_alone = False
        self._late_at = -1  # number of an exchange
        # Time without a message of the hub since it was asked; counted in turns of the thread, since the whole job may
        # be suspended.
        self._silent_turns: int | None = None
        self._asked = 0.0
        # An exchange longer than the time-out, and how often the hub has answered that no rank was behind in it.
        self._none_behind = -1, 0
        self._broken_since: float | None = None
        # Process id of torchrun's agent, because its ranks are not ended when it dies. Other launchers end theirs, and
        # a shell that started ranks in the background may exit.
        self._agent = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        if channel is not None:
            self._thread = threading.Thread(target=self._watch, name="pgccd-guard", daemon=True)
            self._thread.start()
            # Closes the guard at exit, if the caller does not.
            atexit.register(self._leave)

    @contextmanager
    def waiting(self, what: str, for_gpu: bool = False) -> Iterator[None]:
        """Wraps every exchange. Raises `RankFailureError` instead of an error in it if another rank is at fault.

        Args:
            what: for messages.
            for_gpu: whether this waits for kernels that wait for messages, without a time-out of their own. Such an
                exchange ends the process if it takes longer than twice the guard's time-out.
        """
        with self._lock:
            self._exchanges += 1
            self._progress = time.monotonic()
            self._is_waiting, self._is_for_gpu = True, for_gpu
        try:
            yield
        except RuntimeError as error:
            verdict = self._ask(time.monotonic() - self._progress > _LATE * self._timeout)
            if verdict is None:
                raise
            # NCCL's shutdown, and MPI's, wait for all ranks.
            self._ends_hard = self.is_broken is not None or "mpi4py.MPI" in sys.modules
            raise RankFailureError(f"{verdict} (rank {self._rank} was in {self.activity}, {what})") from error
        finally:
            self._is_waiting = False

    def report(self, error: BaseException) -> None:
        """Reports to all ranks that this one fails with an error of its own."""
        if self._channel is None or isinstance(error, RankFailureError):
            return
        first_line = f"{type(error).__name__}: {error}".splitlines()[0][:1000]
        self._channel.send(about="failure", text=f"failed in {self.activity}: {first_line}")

    def close(self) -> None:
        """Leaves the job: a rank that has finished is not at fault, unless another waits for it."""
        if self._closed.is_set() or self._channel is None:
            return
        self._closed.set()
        self._channel.send(about="finished")
        self._thread.join(_GRACE_SECONDS)
        self.is_broken = None  # releases the process group before Python exits
        self._channel.close()
        if self._hub is not None:
            self._hub.close(2.0 * _GRACE_SECONDS)  # other ranks may not have read the verdict yet

    def end_hard(self) -> None:
        """Leaves the job; at exit, ends the process without waiting for its GPU, which waits for lost messages."""
        self._ends_hard = True
        self.close()
        if self._channel is None:
            atexit.register(self._leave)

    def _leave(self) -> None:
        """Runs at exit, after errors have been printed."""
        self.close()
        if self._ends_hard:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(_EXIT_CODE)

    def _ask(self, is_late: bool) -> str | None:
        """Describes the rank at fault for a failed exchange; None if all other ranks are alive and, if it is late, none
        is behind.
        """
        if self._channel is None:
            return None
        self._answered.clear()
        if self._verdict is None:
            if self._channel.send(about="error", is_late=is_late):
                if not self._answered.wait(_VERDICT_SECONDS):
                    self._blame_silent_hub()
            else:
                self._answered.wait(_TICK_SECONDS)  # until the thread has detected it too
        return self._verdict or self._ended_hub

    def _watch(self) -> None:
        """The thread: answers the hub, and ends the process if its main thread waits for a message that can never
        arrive.

        Libraries handle a lost rank differently: Gloo raises an error at once, NCCL never returns.
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
        """Queries the hub if an exchange takes too long or messages were lost."""
        assert self._channel is not None
        with self._lock:
            exchanges, still = self._exchanges, time.monotonic() - self._progress
            is_waiting, is_for_gpu = self._is_waiting, self._is_for_gpu
        is_late, since_asked = still > self._timeout, time.monotonic() - self._asked
        is_waiting_for_gpu = is_waiting and is_for_gpu
        if self._agent is not None and os.getppid() != self._agent:
            self._fail("has lost the process that launched it")
        elif is_late and is_waiting and self._ended_hub is not None:
            self._decide(self._ended_hub)
        elif is_waiting_for_gpu and self._none_behind == (exchanges, 2):
            # All ranks have sent what this one waits for. Asked twice, since messages are late, not lost, after all
            # processes have been suspended.
            self._fail("lost messages of other ranks, although all are alive")
        elif is_late and (self._late_at != exchanges or (is_waiting_for_gpu and since_asked > self._timeout)):
            self._late_at, self._asked = exchanges, time.monotonic()
            self._silent_turns = self._silent_turns or 0
            self._channel.send(about="error", is_late=True, exchange=exchanges)
        elif self._silent_turns is not None and self._silent_turns * _TURN_SECONDS > _VERDICT_SECONDS:
            self._blame_silent_hub()
        elif self.is_broken is not None and self.is_broken():
            if self._broken_since is None:
                self._broken_since = time.monotonic()
                self._channel.send(about="error", is_late=False)
            elif time.monotonic() - self._broken_since > _VERDICT_SECONDS:
                self._fail("lost messages of other ranks, although all are alive")

    def _fail(self, text: str) -> None:
        assert self._channel is not None
        self._channel.send(about="failure", text=text)
        self._decide(f"rank {self._rank} {text}")

    def _blame_silent_hub(self) -> None:
        assert self._channel is not None
        if self._rank != 0:
            self._decide(f"rank 0 ({self._channel.peer}) does not answer: stopped, or busy")

    def _read_hub(self) -> None:
        """Handles messages of the hub, waiting for a fraction of a second."""
        assert self._channel is not None
        messages = None if self._is_alone else self._channel.receive(_TURN_SECONDS)
        if messages:
            self._silent_turns = None
        elif self._silent_turns is not None:
            self._silent_turns += 1
        if messages is None:
            if not self._is_alone and self._ended_hub is None and not self._closed.is_set():
                self._decide(f"rank 0 ({self._channel.peer}) has died")
            self._is_alone = True
            self._closed.wait(_TURN_SECONDS)
        for message in messages or []:
            match message.get("about"):
                case "verdict":
                    self._decide(str(message.get("text")))
                case "no verdict":
                    if message.get("is_late"):
                        exchange, times = message.get("exchange", -1), self._none_behind[1]
                        self._none_behind = exchange, times + 1 if exchange == self._none_behind[0] else 1
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
        os._exit(_EXIT_CODE)  # the only way to end a blocking call into a communication library
