"""Finds the cause when a message does not come: a rank that died, hangs, or reported a failure.

Every rank leaves signs of life in a store that all can read (torch's TCPStore): a pulse, counted up by a thread of its
own, and the number of the exchange its main thread has come to. They are read only when a message is late.
"""

from __future__ import annotations

import atexit
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

_PULSE_SECONDS = 1.0
# A rank whose pulse has stood still for so long is dead.
_SILENCE_SECONDS = 4.0
# A rank whose main thread has not reached an exchange for so long checks whether others are alive.
_SUSPICION_SECONDS = 10.0
# What a rank whose exchange cannot end any more is granted for ending it by itself.
_GRACE_SECONDS = 10.0
_EXIT_CODE = 70
_FAILURE = "failure"
_NO_STORE = "the process that keeps the ranks' store has died: rank 0, or the launcher's agent"


class RankFailureError(RuntimeError):
    """Another rank died, hangs or failed; the message names it."""


class Store(Protocol):
    """What the guard needs of torch's stores."""

    def set(self, key: str, value: str) -> object: ...
    def get(self, key: str) -> bytes: ...
    def check(self, keys: list[str]) -> bool: ...
    def multi_get(self, keys: list[str]) -> list[bytes]: ...


class Guard:
    """Signs of life of this rank, and the means to read those of others.

    Args:
        store: a connection used by this guard only; None: without others to watch, errors pass as they are.
        rank, size: of this one; of all.
        timeout: seconds after which an exchange that does not end means that some rank hangs.
        keeps_store: whether the store goes when this process does.

    Example:
        >>> with guard.waiting("halo"):
        ...     work.wait()
    """

    def __init__(
        self,
        store: Store | None = None,
        rank: int = 0,
        size: int = 1,
        timeout: float = 300.0,
        keeps_store: bool = False,
    ) -> None:
        self._store, self._keeps_store = store, keeps_store
        self._rank, self._size, self._timeout = rank, size, timeout
        self._lock = threading.Lock()
        self._exchanges = 0
        self._progress = time.monotonic()
        #: What the rank is about, for messages: set it as often as you like.
        self.activity = "the start"
        #: Whether what carries the messages has noticed that some are lost. Given if it lets a GPU wait for messages
        #: that never come: the process would wait for the GPU, then, even at its end.
        self.is_broken: Callable[[], bool] | None = None
        self._ends_hard = False
        self._closed = threading.Event()
        if store is not None and size > 1:
            self._beat(0)
            self._thread = threading.Thread(target=self._watch, name="pgccd-guard", daemon=True)
            self._thread.start()
            # A thread that is inside the store when the interpreter goes would take the process with it.
            atexit.register(self._leave)

    @contextmanager
    def waiting(self, what: str) -> Iterator[None]:
        """Around every exchange. An error in it becomes a `RankFailureError` if another rank is to blame."""
        with self._lock:
            self._exchanges += 1
            self._progress = time.monotonic()
        try:
            yield
        except RuntimeError as error:
            blame = self._find_culprit()
            if blame is None:
                raise
            self._publish(blame)
            self._ends_hard = self.is_broken is not None
            raise RankFailureError(f"{blame} (rank {self._rank} was in {self.activity}, {what})") from error

    def report(self, error: BaseException) -> None:
        """Reports to all ranks that this one ends with an error of its own."""
        if self._store is None or self._size == 1 or isinstance(error, RankFailureError):
            return
        first_line = f"{type(error).__name__}: {error}".splitlines()[0]
        self._publish(f"{self._name(self._rank)} failed in {self.activity}: {first_line}")

    def close(self) -> None:
        """Stops the pulse: a rank that has finished is not missed."""
        if self._closed.is_set() or self._store is None or self._size == 1:
            return
        self._closed.set()
        self._thread.join(_GRACE_SECONDS)
        self.is_broken = None  # which holds what must go before Python does
        self._sign_off()

    def _leave(self) -> None:
        """At the end of the process, when errors have been printed."""
        self.close()
        if self._ends_hard:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(_EXIT_CODE)

    def _publish(self, blame: str) -> None:
        """The first rank to find the cause publishes it, so that all report the same."""
        assert self._store is not None
        try:
            if not self._store.check([_FAILURE]):
                self._store.set(_FAILURE, blame)
        except RuntimeError:
            return

    def _sign_off(self) -> None:
        """The last sign of life."""
        assert self._store is not None
        try:
            self._store.set(self._key(self._rank), json.dumps({"finished": True}))
            if self._keeps_store and self._store.check([_FAILURE]):
                self._linger()
        except RuntimeError:
            return  # the store has gone with the rank that kept it

    def _linger(self) -> None:
        """Keeps the store until the others have read what happened, or cannot any more."""
        deadline = time.monotonic() + 2.0 * _GRACE_SECONDS
        seen = self._signs()
        since = time.monotonic()
        while time.monotonic() < deadline:
            time.sleep(0.2 * _PULSE_SECONDS)
            signs = self._signs()
            alive = [rank for rank, sign in enumerate(signs) if "pulse" in sign]
            if time.monotonic() - since > _SILENCE_SECONDS:
                alive = [rank for rank in alive if signs[rank] != seen[rank]]
                seen, since = signs, time.monotonic()
            if not alive:
                return

    def _key(self, rank: int) -> str:
        return f"rank/{rank}"

    def _beat(self, pulse: int) -> None:
        assert self._store is not None
        sign = {"pulse": pulse, "exchanges": self._exchanges, "activity": self.activity}
        sign |= {"host": socket.gethostname(), "pid": os.getpid()}
        self._store.set(self._key(self._rank), json.dumps(sign))

    def _watch(self) -> None:
        """The thread: keeps the pulse, and ends the process if its main thread waits for what can never come.

        Libraries differ in what they do about a lost rank: Gloo raises an error at once, NCCL never returns.
        """
        assert self._store is not None
        pulse = 0
        hopeless_since: float | None = None
        broken_since: float | None = None
        seen: dict[int, tuple[dict, float]] = {}  # each rank's newest sign, and since when it has been that
        while not self._closed.wait(_PULSE_SECONDS):
            pulse += 1
            with self._lock:
                still = time.monotonic() - self._progress
            blame = None
            try:
                self._beat(pulse)
                now = time.monotonic()
                if broken_since is None and self.is_broken is not None and self.is_broken():
                    broken_since = now
                if self._store.check([_FAILURE]) or still > _SUSPICION_SECONDS or broken_since is not None:
                    signs = self._signs()
                    seen = {
                        r: seen[r] if r in seen and seen[r][0] == sign else (sign, now) for r, sign in enumerate(signs)
                    }
                    silent = [rank for rank, (_, since) in seen.items() if now - since > _SILENCE_SECONDS]
                    # A process that has ended is silent by then.
                    lost = broken_since is not None and now - broken_since > 2.0 * _SILENCE_SECONDS
                    blame = self._judge(signs, silent, hanging=lost or still > self._timeout)
                    if blame is None and lost:
                        blame = "messages between ranks were lost, though all are alive"
            except RuntimeError:
                blame = _NO_STORE
            if blame is None:
                hopeless_since = None
                continue
            hopeless_since = hopeless_since or time.monotonic()
            if time.monotonic() - hopeless_since < _GRACE_SECONDS or self._closed.is_set():
                continue
            self._publish(blame)
            sys.stderr.write(f"pgccd: rank {self._rank} gives up in {self.activity}: {blame}\n")
            sys.stderr.flush()
            self._sign_off()
            os._exit(_EXIT_CODE)  # nothing gentler ends a call into a communication library

    def _find_culprit(self) -> str | None:
        """Who made an exchange fail, in words; None if all others are alive and not behind. Takes some seconds."""
        if self._store is None or self._size == 1:
            return None
        try:
            before = self._signs()
            time.sleep(_SILENCE_SECONDS)
            after = self._signs()
            return self._judge(after, [rank for rank in range(self._size) if before[rank] == after[rank]], hanging=True)
        except RuntimeError:
            return _NO_STORE

    def _judge(self, signs: list[dict], silent: list[int], hanging: bool) -> str | None:
        """The ranks at fault, in words: those that reported a failure, those that are silent, and (if `hanging`) those
        behind.
        """
        assert self._store is not None
        if self._store.check([_FAILURE]):
            return self._store.get(_FAILURE).decode()
        others = [rank for rank in range(self._size) if rank != self._rank]
        dead = [rank for rank in others if rank in silent and "pulse" in signs[rank]]
        if dead:
            return self._and([f"{self._name(rank, signs[rank])} has died" for rank in dead])
        if not hanging:
            return None
        finished = [rank for rank in others if signs[rank].get("finished")]
        if finished:
            return self._and([f"rank {rank} has ended early" for rank in finished])
        behind = [rank for rank in others if signs[rank].get("exchanges", self._exchanges) < self._exchanges]
        if behind:
            return self._and([f"{self._name(rank, signs[rank])} hangs in {signs[rank]['activity']}" for rank in behind])
        return None

    def _signs(self) -> list[dict]:
        assert self._store is not None
        keys = [self._key(rank) for rank in range(self._size)]
        if self._store.check(keys):
            return [json.loads(sign) for sign in self._store.multi_get(keys)]
        return [json.loads(self._store.get(key)) if self._store.check([key]) else {} for key in keys]

    def _name(self, rank: int, sign: dict | None = None) -> str:
        sign = sign or {"host": socket.gethostname(), "pid": os.getpid()}
        return f"rank {rank} (process {sign['pid']} on {sign['host']})"

    @staticmethod
    def _and(parts: list[str]) -> str:
        return ", ".join(parts[:4]) + (f" and {len(parts) - 4} more" if len(parts) > 4 else "")
