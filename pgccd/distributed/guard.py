"""Who is to blame when a message does not come: a rank that died, hangs, or failed and said so.

Every rank leaves signs of life in a store that all can read (torch's TCPStore): a pulse, counted up by a thread of its
own, and the number of the exchange its main thread has come to. Nobody looks at them while all goes well.
"""

from __future__ import annotations

import atexit
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

_PULSE_SECONDS = 1.0
# A rank whose pulse has stood still for so long is dead.
_SILENCE_SECONDS = 4.0
# What a rank whose exchange cannot end any more is granted for ending it by itself.
_GRACE_SECONDS = 10.0
_EXIT_CODE = 70
_FAILURE = "failure"


class RankFailureError(RuntimeError):
    """Another rank died, hangs or failed; the message names it."""


class Store(Protocol):
    """What the guard needs of torch's stores."""

    def set(self, key: str, value: str) -> object: ...
    def get(self, key: str) -> bytes: ...
    def check(self, keys: list[str]) -> bool: ...


class Guard:
    """Signs of life of this rank, and the means to read those of others.

    Args:
        store: a connection that nobody else uses; None: without others to watch, errors pass as they are.
        rank, size: of this one; of all.
        timeout: seconds after which an exchange that does not end means that some rank hangs.

    Example:
        >>> with guard.waiting("halo"):
        ...     work.wait()
    """

    def __init__(self, store: Store | None = None, rank: int = 0, size: int = 1, timeout: float = 300.0) -> None:
        self._store = store
        self._rank, self._size, self._timeout = rank, size, timeout
        self._lock = threading.Lock()
        self._exchanges = 0
        self._waiting_since: float | None = None
        self._what = "the start"
        #: What the rank is about, for messages: set it as often as you like.
        self.activity = "the start"
        self._closed = threading.Event()
        if store is not None and size > 1:
            self._beat(0)
            self._thread = threading.Thread(target=self._watch, name="pgccd-guard", daemon=True)
            self._thread.start()
            # A thread that is inside the store when the interpreter goes would take the process with it.
            atexit.register(self.close)

    @contextmanager
    def waiting(self, what: str) -> Iterator[None]:
        """Around every exchange. An error in it becomes a `RankFailureError` if another rank is to blame."""
        with self._lock:
            self._exchanges += 1
            self._what, self._waiting_since = what, time.monotonic()
        try:
            yield
        except RuntimeError as error:
            blame = self._find_culprit()
            if blame is None:
                raise
            raise RankFailureError(f"{blame} (rank {self._rank} was in {self.activity}, {what})") from error
        finally:
            with self._lock:
                self._waiting_since = None

    def report(self, error: BaseException) -> None:
        """Tells all ranks that this one ends with an error of its own."""
        if self._store is None or self._size == 1 or isinstance(error, RankFailureError):
            return
        first_line = f"{type(error).__name__}: {error}".splitlines()[0]
        try:
            if not self._store.check([_FAILURE]):
                self._store.set(_FAILURE, f"{self._name(self._rank)} failed in {self.activity}: {first_line}")
        except RuntimeError:
            return  # the store has gone with the rank that kept it: the others know already
        if self._rank == 0:
            time.sleep(2 * _PULSE_SECONDS)  # it may be this process that keeps the store: let the others read it

    def close(self) -> None:
        """Stops the pulse: a rank that has finished is not missed."""
        if not self._closed.is_set() and self._store is not None and self._size > 1:
            self._closed.set()
            self._thread.join(_GRACE_SECONDS)
            try:
                self._store.set(self._key(self._rank), json.dumps({"finished": True}))
            except RuntimeError:
                return

    def _key(self, rank: int) -> str:
        return f"rank/{rank}"

    def _beat(self, pulse: int) -> None:
        assert self._store is not None
        sign = {"pulse": pulse, "exchanges": self._exchanges, "activity": self.activity}
        sign |= {"host": socket.gethostname(), "pid": os.getpid()}
        self._store.set(self._key(self._rank), json.dumps(sign))

    def _watch(self) -> None:
        """The thread: keeps the pulse, and ends the process if its main thread waits for what can never come."""
        assert self._store is not None
        pulse = 0
        hopeless_since: float | None = None
        while not self._closed.wait(_PULSE_SECONDS):
            pulse += 1
            with self._lock:
                waited = 0.0 if self._waiting_since is None else time.monotonic() - self._waiting_since
            try:
                self._beat(pulse)
                hopeless = self._store.check([_FAILURE])
            except RuntimeError:
                hopeless = True  # the store's rank is gone
            if not hopeless and waited < self._timeout:
                hopeless_since = None
                continue
            hopeless_since = hopeless_since or time.monotonic()
            if time.monotonic() - hopeless_since < _GRACE_SECONDS or self._closed.is_set():
                continue
            blame = self._find_culprit() or "another rank has ended"
            sys.stderr.write(f"pgccd: rank {self._rank} gives up in {self.activity}: {blame}\n")
            sys.stderr.flush()
            os._exit(_EXIT_CODE)  # nothing gentler ends a call into a communication library

    def _find_culprit(self) -> str | None:
        """In words; None if all others are alive and not behind."""
        if self._store is None or self._size == 1:
            return None
        try:
            if self._store.check([_FAILURE]):
                return self._store.get(_FAILURE).decode()
            before = self._signs()
            time.sleep(_SILENCE_SECONDS)
            if self._store.check([_FAILURE]):
                return self._store.get(_FAILURE).decode()
            after = self._signs()
        except RuntimeError:
            return "the rank that keeps the store (rank 0, or the launcher's agent) has died"
        others = [rank for rank in range(self._size) if rank != self._rank]
        dead = [rank for rank in others if "pulse" in after[rank] and before[rank] == after[rank]]
        if dead:
            return self._and([f"{self._name(rank, after[rank])} has died" for rank in dead])
        behind = [rank for rank in others if after[rank].get("exchanges", self._exchanges) < self._exchanges]
        if behind:
            return self._and([f"{self._name(rank, after[rank])} hangs in {after[rank]['activity']}" for rank in behind])
        finished = [rank for rank in others if after[rank].get("finished")]
        return self._and([f"rank {rank} has ended early" for rank in finished]) if finished else None

    def _signs(self) -> list[dict]:
        assert self._store is not None
        keys = [self._key(rank) for rank in range(self._size)]
        return [json.loads(self._store.get(key)) if self._store.check([key]) else {} for key in keys]

    def _name(self, rank: int, sign: dict | None = None) -> str:
        sign = sign or {"host": socket.gethostname(), "pid": os.getpid()}
        return f"rank {rank} (process {sign['pid']} on {sign['host']})"

    @staticmethod
    def _and(parts: list[str]) -> str:
        return ", ".join(parts[:4]) + (f" and {len(parts) - 4} more" if len(parts) > 4 else "")
