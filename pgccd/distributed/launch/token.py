"""The job's token, by which its processes authenticate each other: the stores of torch.distributed do not do so.

The token never passes through a store, which any process that can connect may read.
"""

from __future__ import annotations

import os
import secrets
import socket
import time
from pathlib import Path

import torch.distributed as dist

from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.private_files import folders, read_private, refresh, write_private

VARIABLE = "PGCCD_JOB_TOKEN"
_BYTES = 32
_POLL_SECONDS = 0.01
# Seconds until a file of one machine is visible on another: network file systems cache folders.
_SEEN_WITHIN = 20.0
_ADVICE = f"set {VARIABLE} to the same secret on all ranks"


def share_token(store: dist.Store, placement: Placement, timeout: float) -> bytes:
    """The token, on all ranks: from the environment, or from a file that only this user can read, whose name passes
    through the store.

    Args:
        store: shared by all ranks.
        placement: of this rank.
        timeout: seconds within which all ranks must have called this.

    Raises:
        RuntimeError: ranks are missing after the time-out, or this rank does not see the file.
    """
    given = os.environ.get(VARIABLE)
    if given:
        return given.encode()
    if placement.rank == 0:
        return _hand_out(store, placement.size, timeout)
    path = store.get("token/file").decode(errors="replace")
    found = _look_for(Path(path), 0.0 if placement.is_one_machine else min(_SEEN_WITHIN, timeout)) if path else b""
    store.add("token/looked", 1)
    if found:
        return found
    if not path:
        raise RuntimeError(f"token: rank 0 can write no file that only its user can read: {_ADVICE}")
    raise RuntimeError(f"token: {path} of rank 0 is no private file of this user on {socket.gethostname()}: {_ADVICE}")


def _hand_out(store: dist.Store, size: int, timeout: float) -> bytes:
    token = secrets.token_bytes(_BYTES)
    path = write_private(token)
    try:
        store.set("token/file", str(path or ""))
        deadline = time.monotonic() + timeout
        while store.add("token/looked", 0) < size - 1:
            if time.monotonic() > deadline:
                raise RuntimeError(f"not all of {size} ranks connected within {timeout:g} s")
            time.sleep(_POLL_SECONDS)
    finally:
        if path is not None:
            path.unlink(missing_ok=True)
    if path is None:
        tried = " and ".join(map(str, folders()))
        raise RuntimeError(f"token: rank 0 can write no file to {tried}: {_ADVICE}")
    return token


def _look_for(path: Path, seconds: float) -> bytes:
    """The token in the file, as soon as this machine sees it; empty if it does not in that time."""
    deadline = time.monotonic() + seconds
    while not (found := _read(path)) and time.monotonic() < deadline:
        refresh(path.parent)
        time.sleep(10 * _POLL_SECONDS)
    return found


def _read(path: Path) -> bytes:
    """The token in a private file; empty if it holds none."""
    token = read_private(path)
    return token if len(token) == _BYTES else b""
