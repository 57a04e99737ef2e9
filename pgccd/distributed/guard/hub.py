"""Rank 0's side of the guard: finds the rank at fault, and sends the verdict to all."""

from __future__ import annotations

import contextlib
import resource
import selectors
import socket
import sys
import threading
import time
from dataclasses import dataclass

from pgccd.distributed.guard.channel import Channel, Greeting, Message

_TICK_SECONDS = 1.0
# Time for a new connection to authenticate.
_GREETING_SECONDS = 10.0
# Time for a rank to answer, unless it is stopped or its interpreter is busy.
_ANSWER_SECONDS = 5.0
# Open files that a process needs besides the connections.
_OTHER_FILES = 512


@dataclass
class _Member:
    """A connected rank."""

    channel: Channel
    name: str
    finished: bool = False  #: it has finished, so its silence is no fault


@dataclass
class _Inquiry:
    """A query of the progress of all ranks."""

    number: int
    askers: dict[int, int]  #: ranks, and the number of the exchange that each asks about
    is_late: bool  #: whether an exchange took longer than the time-out
    deadline: float
    answers: dict[int, Message]


class Hub:
    """Finds the rank at fault.

    Args:
        host: the address to listen on; empty: all of this machine's.
        token: of the job; processes without it are rejected.
        size: number of ranks.
    """

    def __init__(self, host: str, token: bytes, size: int) -> None:
        self._token, self._size = token, size
        _allow_files(size + _OTHER_FILES)
        self._listener = _listen(host, min(size, 4096))
        self.port: int = self._listener.getsockname()[1]
        self._greetings: dict[Channel, tuple[Greeting, float]] = {}
        self._members: dict[int, _Member] = {}
        self._ranks: dict[Channel, int] = {}
        self._verdict: str | None = None
        self._inquiry: _Inquiry | None = None
        self._inquiries = 0
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="pgccd-hub", daemon=True)
        self._thread.start()

    def close(self, seconds: float) -> None:
        """Closes at once; or, if there was a verdict, once all ranks have read it, or after `seconds`."""
        self._deadline = time.monotonic() + seconds
        self._closing.set()
        self._thread.join(seconds + 2.0 * _TICK_SECONDS)

    def _serve(self) -> None:
        with contextlib.ExitStack() as stack:
            stack.callback(self._close_all)
            while not self._closing.is_set() or (
                self._verdict is not None and self._ranks and time.monotonic() < self._deadline
            ):
                for key, _ in self._selector.select(0.1 if self._closing.is_set() else 0.2 * _TICK_SECONDS):
                    if key.fileobj is self._listener:
                        self._accept()
                    else:
                        self._read(key.fileobj)  # type: ignore[arg-type]
                self._drop_strangers()
                if self._inquiry is not None:
                    self._decide(self._inquiry)

    def _close_all(self) -> None:
        for channel in self._ranks:
            channel.send(about="closing")
        for channel in [*self._greetings, *self._ranks]:
            channel.close()
        self._selector.close()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            channel = Channel(self._listener.accept()[0])
            self._greetings[channel] = Greeting(channel, self._token).start(), time.monotonic() + _GREETING_SECONDS
            self._selector.register(channel, selectors.EVENT_READ)

    def _drop_strangers(self) -> None:
        now = time.monotonic()
        for channel in [channel for channel, (_, deadline) in self._greetings.items() if now > deadline]:
            self._forget(channel)

    def _forget(self, channel: Channel) -> None:
        self._greetings.pop(channel, None)
        self._selector.unregister(channel)
        channel.close()

    def _read(self, channel: Channel) -> None:
        try:
            messages = channel.receive(0.0)
        except (ValueError, RecursionError):  # not sent by a rank
            messages = None
        if channel in self._greetings:
            self._greet(channel, messages)
            return
        rank = self._ranks[channel]
        for message in messages or []:
            self._handle(rank, message)
        if messages is None:
            del self._ranks[channel]
            self._forget(channel)
            if not self._members[rank].finished:
                self._blame(f"{self._members[rank].name} has died")

    def _greet(self, channel: Channel, messages: list[Message] | None) -> None:
        if messages == []:
            return
        who = self._greetings[channel][0].check(messages[0]) if messages else None
        if who is None or who["rank"] in self._members:
            self._forget(channel)
            return
        del self._greetings[channel]
        self._ranks[channel] = who["rank"]
        self._members[who["rank"]] = _Member(channel, f"rank {who['rank']} ({who.get('name')})")

    def _handle(self, rank: int, message: Message) -> None:
        member = self._members[rank]
        match message.get("about"):
            case "finished":
                member.finished = True
            case "failure":
                self._blame(f"{member.name} {message.get('text')}")
            case "error":
                self._ask_all(rank, bool(message.get("is_late")), message.get("exchange", -1))
            case "answer" if self._inquiry is not None and message.get("number") == self._inquiry.number:
                self._inquiry.answers[rank] = message

    def _blame(self, verdict: str) -> None:
        """The first verdict holds: later failures follow from it."""
        if self._verdict is not None:
            return
        self._verdict, self._inquiry = verdict, None
        # Printed here, because launchers end all ranks as soon as one has died.
        sys.stderr.write(f"pgccd: {verdict}\n")
        sys.stderr.flush()
        for member in self._members.values():
            member.channel.send(about="verdict", text=verdict)

    def _ask_all(self, asker: int, is_late: bool, exchange: int) -> None:
        if self._verdict is not None:
            self._members[asker].channel.send(about="verdict", text=self._verdict)
        elif self._inquiry is not None:
            self._inquiry.askers[asker] = exchange
            self._inquiry.is_late |= is_late
        else:
            self._inquiries += 1
            deadline = time.monotonic() + _ANSWER_SECONDS
            self._inquiry = _Inquiry(self._inquiries, {asker: exchange}, is_late, deadline, {})
            for member in self._members.values():
                member.channel.send(about="question", number=self._inquiries)

    def _decide(self, inquiry: _Inquiry) -> None:
        """Decides a query once all ranks have answered, or its time is up: at fault are ranks that finished early,
        that do not answer, or, if an exchange timed out, that have not reached it.
        """
        expected = {rank for rank, member in self._members.items() if not member.finished}
        silent = sorted(expected - set(inquiry.answers))
        if silent and time.monotonic() < inquiry.deadline:
            return
        self._inquiry = None
        reached = max(inquiry.answers.get(asker, {}).get("exchanges", 0) for asker in inquiry.askers)
        finished = [f"rank {rank} has ended early" for rank, member in self._members.items() if member.finished]
        behind = [
            f"{self._members[rank].name} hangs in {answer.get('activity')}"
            for rank, answer in sorted(inquiry.answers.items())
            if inquiry.is_late and answer.get("exchanges", 0) < reached
        ]
        stopped = [f"{self._members[rank].name} does not answer: stopped, or busy" for rank in silent]
        for blamed in (finished, behind + stopped):
            if blamed:
                more = f" and {len(blamed) - 4} more" if len(blamed) > 4 else ""
                self._blame(", ".join(blamed[:4]) + more)
                return
        for asker, exchange in inquiry.askers.items():
            self._members[asker].channel.send(about="no verdict", is_late=inquiry.is_late, exchange=exchange)


def _listen(host: str, backlog: int) -> socket.socket:
    """A server on any free port; without a host, of all interfaces, by IPv6 too where the machine has it."""
    if not host and socket.has_dualstack_ipv6():
        with contextlib.suppress(OSError):  # IPv6 may be switched off although sockets of it can be made
            return socket.create_server(("", 0), family=socket.AF_INET6, dualstack_ipv6=True, backlog=backlog)
    return socket.create_server((host, 0), backlog=backlog)


def _allow_files(count: int) -> None:
    """Raises the soft limit of open files to `count`, as far as the hard limit allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < count:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (count if hard < 0 else min(count, hard), hard))
