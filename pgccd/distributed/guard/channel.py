"""Messages between a rank and the hub: JSON lines over TCP, between ends that know the job's token."""

from __future__ import annotations

import hmac
import json
import os
import secrets
import select
import socket
import threading
import time
import weakref
from typing import Any

Message = dict[str, Any]

# A line that is longer is no message.
_LONGEST_LINE = 1 << 16
# Machines that vanish without closing their connections are noticed by the operating system after some 30 s.
_KEEPALIVE = {"TCP_KEEPIDLE": 15, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}

_of_this_process: weakref.WeakSet[Channel] = weakref.WeakSet()


def _close_in_child() -> None:
    """A child process must not keep the connections of its parent open."""
    for channel in list(_of_this_process):
        channel.close()


os.register_at_fork(after_in_child=_close_in_child)


class Channel:
    """One end of a connection. Closed by either side, or by the system with its process.

    Args:
        connection: owned from now on.
    """

    #: The process at the other end, in words.
    peer = ""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self._lock = threading.Lock()
        self._received = b""
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)
        _of_this_process.add(self)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def fileno(self) -> int:
        return self.socket.fileno()

    def send(self, **message: Any) -> bool:
        """False: the connection is closed."""
        try:
            with self._lock:
                self.socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError:
            return False
        return True

    def receive(self, seconds: float) -> list[Message] | None:
        """The messages that have come within so many seconds. None: the connection is closed, and all before are read.

        Raises:
            ValueError: what came is no message.
        """
        try:
            if not self._poll.poll(1e3 * max(0.0, seconds)):
                return []
            data = self.socket.recv(_LONGEST_LINE)
        except OSError:
            return None
        if not data:
            return None
        *lines, self._received = (self._received + data).split(b"\n")
        if len(self._received) > _LONGEST_LINE:
            raise ValueError("a line without an end")
        messages = [json.loads(line) for line in lines]
        if not all(isinstance(message, dict) for message in messages):
            raise ValueError("not a message")
        return messages

    def close(self) -> None:
        self.socket.close()


class Greeting:
    """The hub's part of the proof that both ends know the job's token: neither sends it.

    Args:
        channel: of a process that is not known yet.
        token: the job's.
    """

    def __init__(self, channel: Channel, token: bytes) -> None:
        self.channel, self._token = channel, token
        self._nonce = secrets.token_hex(16)
        channel.send(nonce=self._nonce)

    def check(self, message: Message) -> Message | None:
        """Who it is; None: a process without the token."""
        who, nonce = message.get("who"), str(message.get("nonce"))
        if not isinstance(who, dict) or not isinstance(who.get("rank"), int):
            return None
        expected = _proof(self._token, "rank", who, self._nonce, nonce)
        if not hmac.compare_digest(expected, str(message.get("proof"))):
            return None
        self.channel.send(proof=_proof(self._token, "hub", who, self._nonce, nonce), name=process_name())
        return who


def join(address: tuple[str, int], token: bytes, who: Message, timeout: float) -> Channel:
    """A rank's channel to the hub.

    Args:
        address: the hub's host and port.
        token: the job's.
        who: {"rank": r, "name": ...}: what the hub is told of this process.
        timeout: seconds.

    Raises:
        RuntimeError: there is no hub, or it does not know the token.
    """
    deadline = time.monotonic() + timeout
    try:
        channel = Channel(socket.create_connection(address, timeout=timeout))
        channel.socket.settimeout(None)
        theirs, nonce = str(_next(channel, deadline)["nonce"]), secrets.token_hex(16)
        channel.send(who=who, nonce=nonce, proof=_proof(token, "rank", who, theirs, nonce))
        answer = _next(channel, deadline)
        known = hmac.compare_digest(_proof(token, "hub", who, theirs, nonce), str(answer.get("proof")))
    except (OSError, ValueError, KeyError) as error:
        raise RuntimeError(f"guard: no connection to rank 0 at {address[0]}:{address[1]} ({error})") from error
    if not known:
        raise RuntimeError(f"guard: the process at {address[0]}:{address[1]} does not belong to this job")
    channel.peer = str(answer.get("name"))
    return channel


def process_name() -> str:
    """This process, in words."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def _next(channel: Channel, deadline: float) -> Message:
    while time.monotonic() < deadline:
        messages = channel.receive(deadline - time.monotonic())
        if messages is None:
            raise ValueError("it does not belong to this job, or has ended")
        if messages:
            return messages[0]
    raise ValueError("no answer")


def _proof(token: bytes, side: str, who: Message, of_hub: str, of_rank: str) -> str:
    return hmac.new(token, json.dumps([side, who, of_hub, of_rank]).encode(), "sha256").hexdigest()
