"""Ranks with guards in one process."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from pgccd.distributed.guard import Guard, Hub, channel, guard, hub
from pgccd.distributed.guard.channel import join

TOKEN = b"of this job"


class Ranks:
    """Three ranks in one process, of a job of `size`."""

    def __init__(self, size: int = 3) -> None:
        self.hub = Hub("127.0.0.1", TOKEN, size)
        self.guards = [
            Guard(self.channel(rank), rank, timeout=1.0, hub=self.hub if rank == 0 else None) for rank in range(3)
        ]

    def channel(self, rank: int, token: bytes = TOKEN) -> channel.Channel:
        return join(("127.0.0.1", self.hub.port), token, {"rank": rank, "name": f"process {rank}"}, 5.0)

    def connection(self, rank: int) -> channel.Channel:
        """From the rank to the hub."""
        return self.guards[rank]._channel

    @property
    def members(self) -> dict[int, Any]:
        """What the hub knows of each rank that has joined."""
        return self.hub._members

    @property
    def thread_of_hub(self) -> threading.Thread:
        return self.hub._thread

    def kill(self, rank: int) -> None:
        """Closes the rank's connection, as the operating system does when a process ends."""
        killed = self.guards[rank]
        killed._closed.set()
        self.connection(rank).socket.shutdown(socket.SHUT_RDWR)
        killed._thread.join()

    def end_process(self, rank: int) -> None:
        """What the guard of the rank does when its process ends."""
        self.guards[rank]._leave()


def ranks_of(size: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ranks]:
    monkeypatch.setattr(guard, "_GRACE_SECONDS", 0.5)
    monkeypatch.setattr(hub, "_ANSWER_SECONDS", 1.0)
    monkeypatch.setattr(hub, "_SECOND_LOOK_SECONDS", 0.2)
    three = Ranks(size)
    yield three
    for one in three.guards[::-1]:
        one.close()
        one._ends_hard = False  # otherwise the test process would exit like a failed rank


def verdict_of(one: Guard | Hub) -> str | None:
    """Which rank is lost and why, as a guard or the hub has decided, or None; `Guard.waiting` raises it only once."""
    return one._verdict


def fail(rank: Guard, after: float = 0.0) -> str:
    with pytest.raises(RuntimeError) as caught, rank.waiting("halo"):
        time.sleep(after)
        raise RuntimeError("connection closed by peer")
    return str(caught.value)


def wait_for(is_so: Callable[[], object]) -> None:
    deadline = time.monotonic() + 20.0
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.02)
