"""A rank's side of the guard: wraps every exchange, and answers the hub from a thread."""

from __future__ import annotations

import atexit
import faulthandler
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from pgccd.distributed.guard import terminate
from pgccd.distributed.guard.channel import Channel, one_line
from pgccd.distributed.guard.hub import Hub
from pgccd.distributed.guard.turns import TurnClock

_TICK_SECONDS = 1.0
# Duration of a turn of the thread.
_TURN_SECONDS = 0.2
# Maximum time to wait for the hub's verdict: two queries of its own, and the time between them.
_VERDICT_SECONDS = 20.0
# Time for a rank to end a failed exchange by itself before the process is killed.
_GRACE_SECONDS = 10.0
_EXIT_CODE = 70
# Time in an exchange of a call that failed on another rank, after which that rank is at fault; and for the hub to note
# a failure.
_STUCK_SECONDS, _NOTED_SECONDS = 1.0, 2.0
# Calls reported in one message.
_CALLS_A_LINE = 256
# An error after this fraction of the time-out counts as a time-out, since libraries measure time differently.
_LATE = 0.9


class RankFailureError(RuntimeError):
    """Another rank died, hangs or failed, or ranks call different things; the message names them."""


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
        timeout: seconds after which a pending exchange means that a rank hangs. Time in which this process was stopped
            does not count.
        hub: on rank 0.

    Example:
        >>> with guard.waiting("halo"):
        ...     work.wait()
    """

    def __init__(
        self, channel: Channel | None = None, rank: int = 0, timeout: float = 300.0, hub: Hub | None = None
    ) -> None:
        self._channel, self._rank, self._timeout = channel, rank, timeout
        #: On rank 0.
        self.hub = hub
        self._lock = threading.Lock()
        self._exchanges, self._is_waiting, self._may_last = 0, False, False
        # Public calls of this rank, and the thread that is in one; whether the last one failed here, perhaps not on all
        # ranks; and the failed calls of other ranks, by number.
        self._calls, self._caller, self._calls_lock = 0, 0, threading.Lock()
        self._untold: list[str] = []  # names of the last calls, of which the hub does not know yet
        self._has_failed_call, self._failed_calls = False, set[int]()
        self._error = 0  #: id of the error that the last failed call raised
        self._noted, self._settled = threading.Event(), threading.Event()
        self._clock = TurnClock()
        self._progress = 0.0  # of the clock
        #: The public call that the rank is in or was in last, or a part of it, for messages; cheap to set.
        self.activity = "the start"
        #: Whether the communication library has recorded lost messages. Set for NCCL, where a GPU waits for such
        #: messages forever, and the process for the GPU, even at exit.
        self.is_broken: Callable[[], bool] | None = None
        self._ends_hard = False
        self._closed = threading.Event()
        self._verdict: str | None = None
        self._is_final = False  # whether the verdict cannot be withdrawn
        self._has_failed = False  # whether an exchange has, so that this rank cannot go on
        # Set by a verdict, and by the hub's answer that there is none.
        self._answered = threading.Event()
        # Used only by the thread.
        self._ended_hub: str | None = None
        self._is_alone = False
        # Number of the exchange about which the hub was asked, and whether this rank was waiting in it.
        self._late_at, self._late_in = -1, False
        # Of the clock: when the hub was asked, and since when it has sent no message, None if it owes none.
        self._asked = 0.0
        self._silent_since: float | None = None
        # An exchange longer than the time-out, and how often the hub has answered that no rank was behind in it.
        self._none_behind = -1, 0
        self._broken_since: float | None = None
        self._reported: set[str] = set()
        # Process id of torchrun's agent, because its ranks are not ended when it dies. Other launchers end theirs, and
        # a shell that started ranks in the background may exit.
        self._agent = os.getppid() if "TORCHELASTIC_RUN_ID" in os.environ else None
        if channel is not None:
            self._thread = threading.Thread(target=self._watch, name="pgccd-guard", daemon=True)
            self._thread.start()
            terminate.catch_errors_of_threads()
            # Closes the guard at exit, if the caller does not.
            atexit.register(self._leave)

    @property
    def address(self) -> str:
        """The address of this machine on the connection to the hub; empty without one."""
        return "" if self._channel is None else str(self._channel.socket.getsockname()[0])

    @contextmanager
    def waiting(self, what: str, may_last: bool = False) -> Iterator[None]:
        """Wraps every exchange. Raises `RankFailureError` instead of an error in it if another rank is at fault. An
        exchange in which no rank is behind ends the job if it takes longer than twice the guard's time-out.

        Args:
            what: for messages.
            may_last: whether it may take any time, because it waits for something other than messages.
        """
        with self._lock:
            self._exchanges += 1
            self._progress = self._clock.now
            self._is_waiting, self._may_last = True, may_last
        try:
            yield
        except RuntimeError as error:
            self._has_failed = True
            verdict = self._ask(self._clock.now - self._progress > _LATE * self._timeout)
            if verdict is None:
                self._has_failed = False
                raise
            # NCCL's shutdown, and MPI's, wait for all ranks.
            self._ends_hard |= self.is_broken is not None or "mpi4py.MPI" in sys.modules
            raise RankFailureError(f"{verdict} (rank {self._rank} was in {self._place()}, {what})") from error
        finally:
            self._is_waiting = False

    def begin_call(self, name: str) -> bool:
        """Notes a public call that all ranks make in the same order; the thread tells the hub. Returns False for a call
        within a call, which does not count. After True, `end_call` must follow.

        Raises:
            RankFailureError: there is a verdict.
            RuntimeError: another thread is in a call, so that ranks may make them in different orders.
        """
        if self._channel is None or self._caller == threading.get_ident():
            return False
        if self._has_failed_call:
            self._settle(name)
        if self._verdict is not None and self._is_final:
            raise RankFailureError(f"{self._verdict} (rank {self._rank} was about to call {name})")
        with self._calls_lock:
            if self._caller:
                raise RuntimeError(f"{name}: another thread of rank {self._rank} is in such a call")
            self._caller, self._calls = threading.get_ident(), self._calls + 1
            self._untold.append(name)
        self.activity = name
        return True

    def end_call(self) -> None:
        """After `begin_call` returned True."""
        self._caller = 0

    def fail_call(self, error: Exception) -> None:
        """Before `end_call`, if the call raises an error. Raises `RankFailureError` if ranks call different things,
        which may have caused the error.
        """
        if self._channel is None or isinstance(error, RankFailureError):
            return
        self._error = id(error)
        is_of_all = is_of_all_ranks(error)
        self._noted.clear()
        self._settled.clear()
        text = None if is_of_all else _first_line(error)
        if self._send(about="failed call", number=self._calls, text=text):
            self._noted.wait(_NOTED_SECONDS)
        if self._verdict is not None and self._is_final:
            self._ends_hard = True
            raise RankFailureError(f"{self._verdict} (rank {self._rank} was in {self._place()})") from error
        self._has_failed_call = not is_of_all

    def _place(self) -> str:
        """Where this rank is, for messages."""
        is_after = self._calls > 0 and self._caller == 0
        return f"its own code, after {self.activity}" if is_after else self.activity

    def _send(self, **message: Any) -> bool:
        """Sends a message to the hub, after all calls that it does not know yet; False if the connection is closed."""
        assert self._channel is not None
        self._tell_calls()
        return self._channel.send(**message)

    def _tell_calls(self) -> None:
        assert self._channel is not None
        with self._calls_lock:
            names, self._untold = self._untold, []
            for first in range(0, len(names), _CALLS_A_LINE):
                number = self._calls - len(names) + first + 1
                self._channel.send(about="calls", number=number, names=names[first : first + _CALLS_A_LINE])

    def _settle(self, name: str) -> None:
        """After an error in a call that was caught: waits until no rank is in that call any more. Otherwise this rank's
        messages would be taken for those of the call.
        """
        with self.waiting(f"{name}, after an error in the call before"):
            while not self._settled.wait(_TURN_SECONDS):
                self.require_no_verdict()
        self._has_failed_call = False

    def require_no_verdict(self) -> None:
        """Called from time to time while waiting for a message. Raises RuntimeError if the wait cannot end."""
        if self._verdict is not None and self._is_final:
            self._ends_hard = True  # the library's shutdown would wait for the message, too
            raise RuntimeError("a message has not arrived")

    def report(self, error: BaseException) -> None:
        """Reports to all ranks that this one fails with an error of its own."""
        if self._channel is None or isinstance(error, RankFailureError):
            return
        place = self.activity if id(error) == self._error else self._place()
        self._send(about="failure", text=f"failed in {place}: {_first_line(error)}")

    def close(self) -> None:
        """Leaves the job: a rank that has finished is not at fault, unless another waits for it."""
        if self._closed.is_set() or self._channel is None:
            return
        self._closed.set()
        self._send(about="finished")
        self._thread.join(_GRACE_SECONDS)
        self.is_broken = None  # releases the process group before Python exits
        self._channel.close()
        if self.hub is not None:
            self.hub.close(2.0 * _GRACE_SECONDS)  # other ranks may not have read the verdict yet

    def end_hard(self) -> None:
        """Leaves the job; at exit, ends the process without waiting for its GPU, which waits for lost messages."""
        self._ends_hard = True
        self.close()
        if self._channel is None:
            atexit.register(self._leave)

    def _leave(self) -> None:
        """Runs at exit, after errors have been printed."""
        error = getattr(sys, "last_value", None)
        if error is not None and not hasattr(sys, "ps1") and not self._closed.is_set():
            self.report(error)  # not raised within `with`
        self.close()
        if self.hub is not None:
            self.hub.repeat_verdict()
        if self._ends_hard or terminate.is_stopped.is_set():
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
            if self._send(about="error", is_late=is_late):
                begin = self._clock.now
                while not self._answered.wait(_TURN_SECONDS):
                    if self._clock.now - begin > _VERDICT_SECONDS:
                        self._blame_silent_hub()
                        break
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
            try:
                self._tell_calls()
                self._read_hub()
                now = self._clock.turn()
                if self._verdict is None:
                    self._look_at_this_rank()
                else:
                    self._look_whether_it_goes_on()
            except Exception as error:  # of any kind: this thread goes on to answer the hub
                self._tell_once(f"the guard of rank {self._rank} has failed ({type(error).__name__}: {error})")
                self._closed.wait(_TURN_SECONDS)
                continue
            if self._verdict is None:
                hopeless_since = None
            elif hopeless_since is None:
                hopeless_since = now
            elif now - hopeless_since > _GRACE_SECONDS and not self._closed.is_set():
                self._give_up(self._verdict)

    def _tell_once(self, problem: str) -> None:
        if problem not in self._reported:
            self._reported.add(problem)
            sys.stderr.write(f"pgccd: {problem}\n")
            sys.stderr.flush()

    def _look_at_this_rank(self) -> None:
        """Queries the hub if an exchange takes too long or messages were lost."""
        assert self._channel is not None
        now = self._clock.now
        with self._lock:
            exchanges, still = self._exchanges, now - self._progress
            is_waiting, ends = self._is_waiting, self._is_waiting and not self._may_last
        is_late, since_asked = still > self._timeout, now - self._asked
        if self._agent is not None and os.getppid() != self._agent:
            self._fail("has lost the process that launched it")
        elif is_late and is_waiting and self._ended_hub is not None:
            self._decide(self._ended_hub)
        elif ends and still > _STUCK_SECONDS and self._calls in self._failed_calls:
            self._failed_calls.discard(self._calls)
            self._send(about="stuck", number=self._calls)
        elif ends and self._none_behind == (exchanges, 2):
            # All ranks have sent what this one waits for, or wait for other messages. Asked twice, since messages are
            # late, not lost, after all processes have been suspended.
            self._fail("lost messages of other ranks, although all are alive", is_hang=True)
        elif is_late and (self._late_at != exchanges or (ends and since_asked > self._timeout)):
            self._late_at, self._late_in, self._asked = exchanges, is_waiting, now
            self._silent_since = now if self._silent_since is None else self._silent_since
            self._send(about="error", is_late=True, exchange=exchanges)
        elif self._silent_since is not None and now - self._silent_since > _VERDICT_SECONDS:
            self._blame_silent_hub()
        elif self.is_broken is not None and self.is_broken():
            if self._broken_since is None:
                self._broken_since = now
                self._send(about="error", is_late=False)
            elif now - self._broken_since > _VERDICT_SECONDS:
                self._fail("lost messages of other ranks, although all are alive")

    def _look_whether_it_goes_on(self) -> None:
        """Withdraws a verdict about ranks that were silent or behind if the exchange that was late has completed."""
        if self._is_final or self._has_failed or self._late_at < 0:
            return
        with self._lock:
            goes_on = self._exchanges != self._late_at or (self._late_in and not self._is_waiting)
        if goes_on:
            self._send(about="goes on")
            self._withdraw()

    def _withdraw(self) -> None:
        self._verdict, self._late_at, self._silent_since = None, -1, None
        self._answered.clear()

    def _fail(self, text: str, is_hang: bool = False) -> None:
        if is_hang:
            self._print_stack()
        self._send(about="failure", text=text, is_hang=is_hang)
        self._decide(f"rank {self._rank} {text}")

    def _blame_silent_hub(self) -> None:
        assert self._channel is not None
        if self._rank != 0:
            self._decide(f"rank 0 ({self._channel.peer}) does not answer: stopped, or busy", is_final=False)

    def _read_hub(self) -> None:
        """Handles messages of the hub, waiting for a fraction of a second."""
        assert self._channel is not None
        try:
            messages = None if self._is_alone else self._channel.receive(_TURN_SECONDS)
        except ValueError:
            self._decide("the connection to rank 0 carries lines that rank 0 has not sent")
            messages = None
        if messages:
            self._silent_since = None
        if messages is None:
            if not self._is_alone and self._ended_hub is None and not self._closed.is_set():
                if self.hub is None:
                    self._decide(f"rank 0 ({self._channel.peer}) has died")
                else:  # in this process
                    self._ended_hub = "the hub of the guard has failed"
            self._is_alone = True
            self._closed.wait(_TURN_SECONDS)
        for message in messages or []:
            match message.get("about"):
                case "verdict":
                    if message.get("is_hang") and self._verdict is None:
                        self._print_stack()
                    self._decide(str(message.get("text")), is_final=bool(message.get("is_final")))
                case "failed call":
                    self._failed_calls.add(message.get("number", 0))
                case "noted":
                    self._noted.set()
                case "settled":
                    self._failed_calls.discard(message.get("number", 0))
                    self._settled.set()
                case "withdrawn":
                    if not self._is_final:
                        self._withdraw()
                case "no verdict":
                    if message.get("is_late"):
                        exchange, times = message.get("exchange", -1), self._none_behind[1]
                        self._none_behind = exchange, times + 1 if exchange == self._none_behind[0] else 1
                    self._answered.set()
                case "hub failed":
                    self._ended_hub = f"a message has not arrived, and {message.get('text')}"
                case "closing":
                    self._ended_hub = self._ended_hub or "rank 0 has ended early"
                case "question":
                    with self._lock:
                        exchanges = self._exchanges
                    here = {"exchanges": exchanges, "activity": self._place()}
                    self._send(about="answer", number=message.get("number"), **here)

    def _decide(self, verdict: str, is_final: bool = True) -> None:
        if self._verdict is None:
            self._verdict, self._is_final = one_line(verdict), is_final
            if is_final:
                terminate.has_verdict.set()
        self._answered.set()
        self._noted.set()

    def _print_stack(self) -> None:
        """Where the threads of this rank are, for a verdict about ranks that hang."""
        with suppress(Exception):  # without a standard error, for example
            sys.__stderr__.write(f"pgccd: rank {self._rank} is in {self._place()}:\n")  # type: ignore[union-attr]
            sys.__stderr__.flush()  # type: ignore[union-attr]
            faulthandler.dump_traceback(sys.__stderr__)  # type: ignore[arg-type]

    def _give_up(self, verdict: str) -> None:
        sys.stderr.write(f"pgccd: rank {self._rank} gives up in {self._place()}: {verdict}\n")
        sys.stderr.flush()
        os._exit(_EXIT_CODE)  # the only way to end a blocking call into a communication library


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:1000]
