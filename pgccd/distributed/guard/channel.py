"""Messages between a rank and the hub: JSON lines over TCP, authenticated by the job's token.

Both ends first prove that they have the token. From then on every line begins with its message authentication code
(MAC), by a key that only these two ends know. A process in the middle that forwards the proofs cannot send, repeat,
drop or exchange lines.

`multiprocessing.connection`, which authenticates too, is not used: its listener waits for a process that connects and
stays silent, and its messages are pickles.
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
# Characters of a MAC: 16 bytes of SHA-256.
_MAC_LENGTH = 32
# Longest text of a verdict.
_LONGEST_TEXT = 2000
# TCP keep-alive: probes of a machine that has vanished.
_PROBES = 5
# Interval between attempts to join.
_AGAIN_SECONDS = 0.1

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
        patience: seconds after which a machine that no longer answers counts as lost, and the connection as closed.
    """

    #: Description of the process at the other end.
    peer = ""
    #: Whether no more messages will come: the connection is closed, or what came was not a message.
    has_ended = False

    def __init__(self, connection: socket.socket, patience: float = 30.0) -> None:
        self.socket = connection
        self._lock = threading.Lock()
        self._received = b""
        # Of both directions, once the other end is known: the key of MACs, and the number of lines.
        self._keys: tuple[bytes, bytes] | None = None
        self._counts = [0, 0]
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)
        _of_this_process.add(self)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        interval = max(1, min(int(patience / (2 * _PROBES)), 3600))
        keep_alive = {"TCP_KEEPIDLE": _PROBES * interval, "TCP_KEEPINTVL": interval, "TCP_KEEPCNT": _PROBES}
        for name, value in keep_alive.items():
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def fileno(self) -> int:
        return self.socket.fileno()

    def secure(self, secret: bytes, is_hub: bool) -> None:
        """From now on lines carry MACs, by keys from a secret that both ends have, one for each direction."""
        of_hub, of_rank = (hmac.digest(secret, side, "sha256") for side in (b"hub", b"rank"))
        self._keys, self._counts = (of_hub, of_rank) if is_hub else (of_rank, of_hub), [0, 0]

    def send(self, **message: Any) -> bool:
        """Sends a message; False if the connection is closed."""
        line = json.dumps(message).encode()
        try:
            with self._lock:
                self.socket.sendall(self._mac(line, 0) + line + b"\n")
                self._counts[0] += 1
        except OSError:
            return False
        return True

    def _mac(self, line: bytes, direction: int) -> bytes:
        if self._keys is None:
            return b""
        number = b"%d " % self._counts[direction]
        return hmac.digest(self._keys[direction], number + line, "sha256").hex()[:_MAC_LENGTH].encode()

    def receive(self, seconds: float) -> list[Message] | None:
        """The messages received within `seconds`. None: the connection is closed, and all messages have been read.

        Raises:
            ValueError: the received data is not a message, or not the next one of the other end. No more are read.
        """
        if not self._has_line() and not self._read(seconds):
            return None if self.has_ended else []
        messages = []
        while self._has_line():
            messages.append(self._next_message())
        return messages

    def receive_one(self, seconds: float) -> Message | None:
        """The next message, if it is received within `seconds`; raises as `receive`."""
        if not self._has_line():
            self._read(seconds)
        return self._next_message() if self._has_line() else None

    def _has_line(self) -> bool:
        return b"\n" in self._received

    def _read(self, seconds: float) -> bool:
        """Reads what arrives within `seconds`; False if nothing did."""
        if self.has_ended:
            return False
        try:
            if not self._poll.poll(1e3 * max(0.0, seconds)):
                return False
            data = self.socket.recv(_LONGEST_LINE)
        except OSError:
            data = b""
        self.has_ended = not data
        self._received += data
        if len(self._received.rpartition(b"\n")[2]) > _LONGEST_LINE:
            self._end()
            raise ValueError("a line without an end")
        return not self.has_ended

    def _end(self) -> None:
        self.has_ended, self._received = True, b""

    def _next_message(self) -> Message:
        line, _, self._received = self._received.partition(b"\n")
        try:
            if self._keys is not None:
                mac, line = line[:_MAC_LENGTH], line[_MAC_LENGTH:]
                if not hmac.compare_digest(mac, self._mac(line, 1)):
                    raise ValueError("a line that the other end has not sent, or not now")
                self._counts[1] += 1
            message = json.loads(line)
            if not isinstance(message, dict):
                raise ValueError("not a message")
        except RecursionError as error:
            self._end()
            raise ValueError("nested too deeply") from error
        except ValueError:
            self._end()
            raise
        return message

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
        """The identity of the rank; None if it does not have the token, which it is told."""
        who, nonce = message.get("who"), str(message.get("nonce"))
        is_rank = isinstance(who, dict) and type(who.get("rank")) is int
        if not is_rank or not _are_equal(_proof(self._token, "rank", who, self._nonce, nonce), message.get("proof")):
            self.channel.send(refused=True)
            return None
        self._nonce_of_rank = nonce
        return who

    def accept(self, who: Message) -> None:
        """Tells a rank that has been checked that it belongs to the job, and so does the hub."""
        proof = _proof(self._token, "hub", who, self._nonce, self._nonce_of_rank)
        self.channel.send(proof=proof, name=process_name())
        self.channel.secure(_secret(self._token, who, self._nonce, self._nonce_of_rank), is_hub=True)


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
    while True:
        try:
            channel = _greet(address, token, who, deadline, timeout)
        except (OSError, ValueError, KeyError) as error:
            raise RuntimeError(f"guard: no connection to rank 0 at {address[0]}:{address[1]} ({error})") from error
        if channel is not None:
            return channel
        if time.monotonic() > deadline:
            raise RuntimeError(
                f"guard: no connection to rank 0 at {address[0]}:{address[1]} (it closes each connection)"
            )
        time.sleep(_AGAIN_SECONDS)  # it has dropped this connection among many others


def _greet(address: tuple[str, int], token: bytes, who: Message, deadline: float, patience: float) -> Channel | None:
    """A connection to the hub; None if it was closed before the hub knew whose it is.

    Raises:
        RuntimeError: the hub does not have the token.
        OSError, ValueError, KeyError: there is no hub, or it refuses this process.
    """
    left = max(0.1, deadline - time.monotonic())
    channel, is_joined = Channel(socket.create_connection(address, timeout=left), patience), False
    try:
        channel.socket.settimeout(None)
        first = _next(channel, deadline)
        if first is None:
            return None
        theirs, nonce = str(first["nonce"]), secrets.token_hex(16)
        channel.send(who=who, nonce=nonce, proof=_proof(token, "rank", who, theirs, nonce))
        answer = _next(channel, deadline)
        if answer is None:
            return None
        if answer.get("refused"):
            raise ValueError("it does not accept this rank: is PGCCD_JOB_TOKEN the same on all?")
        if not _are_equal(_proof(token, "hub", who, theirs, nonce), answer.get("proof")):
            raise RuntimeError(f"guard: the process at {address[0]}:{address[1]} does not belong to this job")
        channel.peer = one_line(str(answer.get("name")))
        channel.secure(_secret(token, who, theirs, nonce), is_hub=False)
        is_joined = True
        return channel
    finally:
        if not is_joined:
            channel.close()


def process_name() -> str:
    """Process id and host name, for messages."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def one_line(text: str) -> str:
    """Text of another process as printable characters in one line, not longer than a few terminal lines."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[:_LONGEST_TEXT])
    return text[:_LONGEST_TEXT]


def _next(channel: Channel, deadline: float) -> Message | None:
    """The next message; None if the connection is closed."""
    while time.monotonic() < deadline:
        message = channel.receive_one(deadline - time.monotonic())
        if message is not None:
            return message
        if channel.has_ended:
            return None
    raise ValueError("no answer")


def _are_equal(proof: str, given: Any) -> bool:
    return hmac.compare_digest(proof.encode(), str(given).encode(errors="replace"))


def _proof(token: bytes, side: str, who: Any, of_hub: str, of_rank: str) -> str:
    return hmac.new(token, json.dumps([side, who, of_hub, of_rank]).encode(), "sha256").hexdigest()


def _secret(token: bytes, who: Any, of_hub: str, of_rank: str) -> bytes:
    return bytes.fromhex(_proof(token, "lines", who, of_hub, of_rank))
