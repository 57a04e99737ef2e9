"""Messages between a rank and the hub: JSON lines over TCP, authenticated by the job's token.

Not `multiprocessing.connection`, which authenticates too: its listener waits for a process that connects and stays
silent, and its messages are pickles.
"""

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

# Longer lines are rejected.
_LONGEST_LINE = 1 << 16
# TCP keep-alive: a machine that vanishes is detected after some 30 s.
_KEEPALIVE = {"TCP_KEEPIDLE": 15, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}

_of_this_process: weakref.WeakSet[Channel] = weakref.WeakSet()


def _close_in_child() -> None:
    """Closes the parent's connections in a forked child."""
    for channel in list(_of_this_process):
        channel.close()


os.register_at_fork(after_in_child=_close_in_child)


class Channel:
    """One end of a connection. Closed by either side, or by the operating system when the process ends.

    Args:
        connection: the channel takes ownership.
    """

    #: Description of the process at the other end.
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
        """Sends a message; False if the connection is closed."""
        try:
            with self._lock:
                self.socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError:
            return False
        return True

    def receive(self, seconds: float) -> list[Message] | None:
        """The messages received within `seconds`. None: the connection is closed, and all messages have been read.

        Raises:
            ValueError: the received data is not a message.
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
    """The hub's side of the authentication: both ends prove possession of the job's token without sending it.

    Args:
        channel: to a process not yet authenticated.
        token: of the job.
    """

    def __init__(self, channel: Channel, token: bytes) -> None:
        self.channel, self._token = channel, token
        self._nonce = secrets.token_hex(16)

    def start(self) -> Greeting:
        """Sends the challenge."""
        self.channel.send(nonce=self._nonce)
        return self

    def check(self, message: Message) -> Message | None:
        """The identity of the rank; None if it does not have the token."""
        who, nonce = message.get("who"), str(message.get("nonce"))
        if not isinstance(who, dict) or not isinstance(who.get("rank"), int):
            return None
        expected = _proof(self._token, "rank", who, self._nonce, nonce)
        if not hmac.compare_digest(expected, str(message.get("proof"))):
            return None
        self.channel.send(proof=_proof(self._token, "hub", who, self._nonce, nonce), name=process_name())
        return who


def join(address: tuple[str, int], token: bytes, who: Message, timeout: float) -> Channel:
    """Connects a rank to the hub.

    Args:
        address: the hub's host and port.
        token: of the job.
        who: {"rank": r, "name": ...}: identifies this process to the hub.
        timeout: seconds.

    Raises:
        RuntimeError: there is no hub, or it does not have the token.
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
    """Process id and host name, for messages."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def _next(channel: Channel, deadline: float) -> Message:
    while time.monotonic() < deadline:
        messages = channel.receive(deadline - time.monotonic())
        if messages is None:
            raise ValueError("it has ended, or does not accept this rank: is PGCCD_JOB_TOKEN the same on all?")
        if messages:
            return messages[0]
    raise ValueError("no answer")


def _proof(token: bytes, side: str, who: Message, of_hub: str, of_rank: str) -> str:
    return hmac.new(token, json.dumps([side, who, of_hub, of_rank]).encode(), "sha256").hexdigest()
