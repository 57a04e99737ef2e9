"""Lines between a rank and the hub: only those of the other end are read, each once and in order."""

from __future__ import annotations

import secrets
import socket

import pytest

from pgccd.distributed.guard import channel


def connected() -> tuple[socket.socket, socket.socket]:
    """Both ends of a TCP connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = socket.create_connection(server.getsockname())
        return one, server.accept()[0]


def test_lines_that_the_other_end_has_not_sent_end_the_channel() -> None:
    """After the proofs: what a process in between adds, changes, repeats, drops, exchanges or sends back."""
    secret = secrets.token_bytes(32)

    def ends() -> tuple[channel.Channel, channel.Channel, socket.socket, socket.socket]:
        """The hub, a rank, and the sockets of the process in between, towards the hub and towards the rank."""
        (of_hub, to_hub), (of_rank, to_rank) = connected(), connected()
        both = channel.Channel(of_hub), channel.Channel(of_rank)
        for each, is_hub in zip(both, (True, False), strict=True):
            each.secure(secret, is_hub)
        return *both, to_hub, to_rank

    def lines_of(from_: channel.Channel, at: socket.socket, *texts: str) -> list[bytes]:
        for text in texts:
            assert from_.send(text=text)
        return at.recv(1 << 16).splitlines(keepends=True)

    texts = ["one", "two", "three"]
    for attack, expected in [
        (lambda lines: lines, 3),
        (lambda lines: [b'{"about": "failure"}\n', *lines], 0),
        (lambda lines: [b"0" * 32 + b'{"about": "failure"}\n', *lines], 0),
        (lambda lines: [lines[0], lines[1].replace(b"two", b"TWO"), lines[2]], 1),
        (lambda lines: [lines[0], lines[0]], 1),
        (lambda lines: [lines[0], lines[2]], 1),
        (lambda lines: [lines[1], lines[0]], 0),
        (lambda lines: [lines[0][:-1] + b" \n"], 0),
        (lambda lines: [lines[0][:31] + b"\n"], 0),
    ]:
        hub_end, rank_end, to_hub, to_rank = ends()
        for line in attack(lines_of(rank_end, to_rank, *texts)):
            to_hub.sendall(line)
        received = []
        if expected == 3:
            assert [message["text"] for message in hub_end.receive(1.0) or []] == texts
            continue
        with pytest.raises(ValueError, match="a line that the other end has not sent"):
            while (message := hub_end.receive_one(0.1)) is not None:
                received.append(message["text"])
        assert received == texts[:expected] and hub_end.receive(0.0) is None
    hub_end, rank_end, to_hub, to_rank = ends()  # sent back to where it came from
    to_rank.sendall(lines_of(rank_end, to_rank, "one")[0])
    with pytest.raises(ValueError, match="a line that the other end has not sent"):
        rank_end.receive(1.0)
