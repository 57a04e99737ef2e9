"""Rank 0's side of the guard: finds the rank at fault, and sends the verdict to all."""

from __future__ import annotations

import contextlib
import resource
import selectors
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from pgccd.distributed.guard.channel import Channel, Greeting, Message, one_line
from pgccd.distributed.guard.turns import TurnClock

_TICK_SECONDS = 1.0
# Time for a new connection to authenticate, and how many may do so at a time besides one for each rank: the oldest is
# dropped for a new one, and a rank that was dropped connects again.
_GREETING_SECONDS, _MOST_GREETINGS = 10.0, 64
# Connections accepted in one turn.
_ACCEPTED = 32
# Time for a rank to answer, unless it is stopped or its interpreter is busy; and from one query to the next.
_ANSWER_SECONDS, _SECOND_LOOK_SECONDS = 5.0, 2.0
# Number of a question whose only purpose is that the rank first tells its calls.
_CALLS = -1
# Open files that a process needs besides the connections.
_OTHER_FILES = 512


@dataclass
class _Member:
    """A connected rank."""

    channel: Channel
    name: str
    finished: bool = False  #: it has finished, so its silence is no fault
    calls: int = 0  #: number of public calls
    call: str = ""  #: name of the last one


@dataclass
class _Inquiry:
    """Queries of the progress of all ranks, until one query shows no rank that may be at fault, or two queries show the
    same ranks.
    """

    askers: dict[int, int]  #: ranks, and the number of the exchange that each asks about
    is_late: bool  #: whether an exchange took longer than the time-out
    begin: float  #: of this query; of the turn clock
    number: int = 0  #: of this query; 0: not yet sent
    answers: dict[int, Message] = field(default_factory=dict)
    #: Ranks that may be at fault by the query before, and the number of exchanges of each, None if it did not answer.
    suspects: dict[int, int | None] = field(default_factory=dict)


class Hub:
    """Finds the rank at fault.

    Args:
        host: the address to listen on; empty: all of this machine's.
        token: of the job; processes without it are rejected.
        size: number of ranks. When all have joined, it listens no longer.
        patience: seconds after which a machine that no longer answers counts as lost.
    """

    def __init__(self, host: str, token: bytes, size: int, patience: float = 30.0) -> None:
        self._token, self._size, self._patience = token, size, patience
        _allow_files(size + _OTHER_FILES)
        self._listener = _listen(host, min(size + _MOST_GREETINGS, 4096))
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._greetings: dict[Channel, tuple[Greeting, float]] = {}
        self._members: dict[int, _Member] = {}
        self._ranks: dict[Channel, int] = {}
        self._verdict: str | None = None
        self._is_final = False  # whether the verdict cannot be withdrawn
        self._inquiry: _Inquiry | None = None
        self._queries = 0
        # By number of a call: the first rank that made it, its name, and how many ranks have made it; and the ranks on
        # which it failed, with the error.
        self._calls: dict[int, tuple[int, str, int]] = {}
        self._failed_calls: dict[int, dict[int, str]] = {}
        # Ranks that wait until all calls made so far have been compared, and ranks that may still tell calls.
        self._to_note: list[tuple[int, set[int]]] = []
        self._clock = TurnClock()
        #: Set once all ranks have joined.
        self.is_complete = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._closing = threading.Event()
        self._outer_address: str | None = None
        self._thread = threading.Thread(target=self._run, name="pgccd-hub", daemon=True)
        self._thread.start()

    def close(self, seconds: float) -> None:
        """Closes at once; or, if there was a verdict, once all ranks have read it, or after `seconds`."""
        self._deadline = time.monotonic() + seconds
        self._closing.set()
        self._thread.join(seconds + 2.0 * _TICK_SECONDS)

    @property
    def outer_address(self) -> str | None:
        """The address of this machine at which ranks of other machines have reached the hub; None if there are none."""
        return self._outer_address

    def missing(self) -> list[int]:
        """Ranks that have not joined."""
        return [rank for rank in range(self._size) if rank not in self._members]

    def _run(self) -> None:
        """The thread."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._close_all)
            try:
                self._serve()
            except Exception as error:  # of any kind: no rank is at fault
                text = f"the hub of the guard, on rank 0, has failed ({type(error).__name__}: {error})"
                for channel in self._ranks:
                    channel.send(about="hub failed", text=text)
                _tell(f"{text}: no rank at fault will be found")

    def _serve(self) -> None:
        while not self._closing.is_set() or (
            self._verdict is not None and self._ranks and time.monotonic() < self._deadline
        ):
            for key, _ in self._selector.select(0.1 if self._closing.is_set() else 0.2 * _TICK_SECONDS):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(key.fileobj)  # type: ignore[arg-type]
            self._clock.turn()
            self._drop_strangers(lambda since: self._clock.now - since > _GREETING_SECONDS)
            if self._inquiry is not None:
                self._look(self._inquiry)

    def _close_all(self) -> None:
        for channel in self._ranks:
            channel.send(about="closing")
        for channel in [*self._greetings, *self._ranks]:
            channel.close()
        self._selector.close()
        self._listener.close()

    def _accept(self) -> None:
        for _ in range(_ACCEPTED):
            try:
                channel = Channel(self._listener.accept()[0], self._patience)
            except BlockingIOError:
                return
            except OSError:  # no file may be opened, for example
                self._drop_oldest()
                return
            if len(self._greetings) >= _MOST_GREETINGS + self._size:
                self._drop_oldest()
            self._greetings[channel] = Greeting(channel, self._token).start(), self._clock.now
            self._selector.register(channel, selectors.EVENT_READ)

    def _drop_oldest(self) -> None:
        if self._greetings:
            self._forget(next(iter(self._greetings)))

    def _drop_strangers(self, is_one: Callable[[float], bool]) -> None:
        for channel in [channel for channel, (_, since) in self._greetings.items() if is_one(since)]:
            self._forget(channel)

    def _forget(self, channel: Channel) -> None:
        self._greetings.pop(channel, None)
        self._selector.unregister(channel)
        channel.close()

    def _read(self, channel: Channel) -> None:
        if channel in self._greetings:
            try:
                self._greet(channel)
            except Exception:  # whatever its kind: an invalid greeting ends this channel, not the hub
                self._forget(channel)
            if len(self._members) == self._size:
                self._stop_listening()
            return
        if channel not in self._ranks:  # dropped in this turn
            return
        what = "has died"
        try:
            messages = channel.receive(0.0)
        except ValueError:  # not sent by the rank
            messages, what = None, "is lost: its connection carries lines that it has not sent"
        rank = self._ranks[channel]
        for message in messages or []:
            self._handle(rank, message)
        if messages is None:
            del self._ranks[channel]
            self._forget(channel)
            if not self._members[rank].finished:
                self._blame(f"{self._members[rank].name} {what}", is_final=True)

    def _greet(self, channel: Channel) -> None:
        message = channel.receive_one(0.0)
        if message is None and not channel.has_ended:
            return
        greeting = self._greetings[channel][0]
        who = None if message is None else greeting.check(message)
        if who is None or who["rank"] in self._members or not 0 <= who["rank"] < self._size:
            if who is not None:
                channel.send(refused=True)
            self._forget(channel)
            return
        rank = who["rank"]
        # First, since the rank goes on as soon as it is accepted.
        self._ranks[channel], self._members[rank] = rank, _Member(channel, one_line(f"rank {rank} ({who.get('name')})"))
        try:
            self._note_address(channel)
            greeting.accept(who)
        except Exception:
            del self._ranks[channel], self._members[rank]
            raise
        del self._greetings[channel]

    def _stop_listening(self) -> None:
        """All ranks have joined."""
        self._selector.unregister(self._listener)
        self._listener.close()
        self._drop_strangers(lambda _: True)
        self.is_complete.set()

    def _note_address(self, channel: Channel) -> None:
        here, there = (end()[0] for end in (channel.socket.getsockname, channel.socket.getpeername))
        if here != there:
            self._outer_address = here

    def _handle(self, rank: int, message: Message) -> None:
        member = self._members[rank]
        match message.get("about"):
            case "finished":
                member.finished = True
                self._compare_ends()
                self._has_told(rank)
            case "calls":
                for number, name in enumerate(message.get("names", []), message.get("number", 0)):
                    self._compare(rank, number, str(name))
            case "failed call":
                others = {other for other, each in self._members.items() if other != rank and not each.finished}
                self._to_note.append((rank, others))
                for other in others:
                    self._members[other].channel.send(about="question", number=_CALLS)
                self._has_told(rank)
                if message.get("text") is not None:
                    self._note_failed(rank, message.get("number", 0), str(message.get("text")))
            case "stuck":
                for failed, text in list(self._failed_calls.get(message.get("number", 0), {}).items())[:1]:
                    self._blame(f"{self._members[failed].name} failed in {text}", is_final=True)
            case "failure":
                self._blame(f"{member.name} {message.get('text')}", True, bool(message.get("is_hang")))
            case "error":
                self._ask_all(rank, bool(message.get("is_late")), message.get("exchange", -1))
            case "answer" if message.get("number") == _CALLS:
                self._has_told(rank)
            case "goes on":
                self._withdraw(member.name)
            case "answer" if self._inquiry is not None and message.get("number") == self._inquiry.number:
                self._inquiry.answers[rank] = message

    def _has_told(self, rank: int) -> None:
        """All calls of a rank up to now have been compared."""
        for asker, others in list(self._to_note):
            others.discard(rank)
            if not others:
                self._to_note.remove((asker, others))
                self._members[asker].channel.send(about="noted")

    def _compare(self, rank: int, number: int, name: str) -> None:
        """Compares a rank's call with those of the same number of other ranks."""
        self._members[rank].calls, self._members[rank].call = number, name
        first, expected, count = self._calls.pop(number, (rank, name, 0))
        if name != expected:
            theirs = f"{self._members[first].name} calls {expected}"
            self._blame(f"{self._members[rank].name} calls {name} where {theirs} (call {number})", is_final=True)
        if count + 1 < self._size:
            self._calls[number] = first, expected, count + 1
        self._compare_ends()
        for failed in list(self._failed_calls):
            self._settle(failed)

    def _compare_ends(self) -> None:
        """Blames a rank that has finished and made fewer calls than another."""
        if not self._calls:
            return
        number = max(self._calls)
        first, name, _ = self._calls[number]
        for rank, member in self._members.items():
            if member.finished and member.calls < number:
                theirs = f"{self._members[first].name} calls {name} (call {number})"
                self._blame(f"{self._end_of(rank)}, after {member.calls} calls, where {theirs}", is_final=True)

    def _end_of(self, rank: int) -> str:
        """Says that a rank has ended, and of which error in a call, if it was one."""
        errors = [texts[rank] for texts in self._failed_calls.values() if rank in texts]
        return f"rank {rank} has ended early" + (f": it failed in {errors[-1]}" if errors else "")

    def _note_failed(self, rank: int, number: int, text: str) -> None:
        """A call has failed on a rank, perhaps not on all: ranks that wait in it must not wait forever."""
        self._failed_calls.setdefault(number, {})[rank] = f"{self._members[rank].call}: {text}"
        for other, member in self._members.items():
            if other not in self._failed_calls[number]:
                member.channel.send(about="failed call", number=number)
        self._settle(number)

    def _settle(self, number: int) -> None:
        """Lets ranks on which a call has failed go on, once no rank is in it."""
        failed = self._failed_calls[number]
        if all(member.finished or member.calls > number or rank in failed for rank, member in self._members.items()):
            del self._failed_calls[number]
            for member in self._members.values():
                member.channel.send(about="settled", number=number)

    def repeat_verdict(self) -> None:
        """Prints a verdict again, below what has been printed meanwhile."""
        if self._verdict is not None:
            _tell(self._verdict)

    def _blame(self, verdict: str, is_final: bool, is_hang: bool = False) -> None:
        """The first verdict holds: later failures follow from it."""
        if self._verdict is not None:
            return
        verdict = one_line(verdict)
        self._verdict, self._is_final, self._inquiry = verdict, is_final, None
        # Printed here, because launchers end all ranks as soon as one has died.
        _tell(verdict)
        for member in self._members.values():
            member.channel.send(about="verdict", text=verdict, is_final=is_final, is_hang=is_hang)

    def _withdraw(self, name: str) -> None:
        """Ranks that were late go on, after the job was suspended for example."""
        if self._verdict is None or self._is_final:
            return
        _tell(f"{name} goes on, and so does the job")
        self._verdict = None
        for member in self._members.values():
            member.channel.send(about="withdrawn")

    def _ask_all(self, asker: int, is_late: bool, exchange: int) -> None:
        if self._verdict is not None:
            self._members[asker].channel.send(about="verdict", text=self._verdict, is_final=self._is_final)
        elif self._inquiry is not None:
            self._inquiry.askers[asker] = exchange
            self._inquiry.is_late |= is_late
        else:
            self._inquiry = _Inquiry({asker: exchange}, is_late, self._clock.now)

    def _look(self, inquiry: _Inquiry) -> None:
        """Decides a query once all ranks have answered, or its time is up. At fault are ranks that finished early; and
        ranks that, by two queries, do not answer, or have not reached an exchange that timed out and made no progress.
        """
        if not inquiry.number:
            if self._clock.now >= inquiry.begin:
                self._queries += 1
                inquiry.number = self._queries
                for member in self._members.values():
                    member.channel.send(about="question", number=inquiry.number)
            return
        expected = {rank for rank, member in self._members.items() if not member.finished}
        silent = sorted(expected - set(inquiry.answers))
        if silent and self._clock.now - inquiry.begin < _ANSWER_SECONDS:
            return
        made = {rank: answer.get("exchanges", 0) for rank, answer in inquiry.answers.items()}
        reached = max(made.get(asker, 0) for asker in inquiry.askers)
        behind = [rank for rank in sorted(made) if inquiry.is_late and made[rank] < reached]
        finished = [self._end_of(rank) for rank, member in self._members.items() if member.finished]
        suspects = {rank: made.get(rank) for rank in [*behind, *silent]}
        blamed = [rank for rank in suspects if inquiry.suspects.get(rank, -1) == suspects[rank]]
        if finished:
            self._blame(_list(finished), is_final=True)
        elif blamed:
            why = {rank: f"hangs in {inquiry.answers[rank].get('activity')}" for rank in behind}
            stopped = "does not answer: stopped, or busy"
            self._blame(
                _list([f"{self._members[rank].name} {why.get(rank, stopped)}" for rank in blamed]), False, is_hang=True
            )
        elif suspects:
            again = self._clock.now + _SECOND_LOOK_SECONDS
            self._inquiry = _Inquiry(inquiry.askers, inquiry.is_late, again, suspects=suspects)
        else:
            self._inquiry = None
            for asker, exchange in inquiry.askers.items():
                self._members[asker].channel.send(about="no verdict", is_late=inquiry.is_late, exchange=exchange)


def _list(texts: list[str]) -> str:
    """The first of several texts."""
    return ", ".join(texts[:4]) + (f" and {len(texts) - 4} more" if len(texts) > 4 else "")


def _tell(text: str) -> None:
    sys.stderr.write(f"pgccd: {text}\n")
    sys.stderr.flush()


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
