"""The job's token, by which its processes authenticate each other: the stores of torch.distributed do not do so."""

from __future__ import annotations

import os
import secrets
import tempfile
import time
import warnings
from datetime import timedelta
from pathlib import Path

import torch.distributed as dist

from pgccd.distributed.launch.placement import Placement

VARIABLE = "PGCCD_JOB_TOKEN"
_BYTES = 32
_POLL_SECONDS = 0.01


def share_token(store: dist.Store, placement: Placement, timeout: float) -> bytes:
    """The token, on all ranks: from the environment, or from a file that only this user can read. If the machines share
    neither, it is sent through the store, which any process that can connect may read.

    Args:
        store: shared by all ranks.
        placement: of this rank.
        timeout: seconds within which all ranks must have called this.

    Raises:
        RuntimeError: ranks are missing after the time-out.
    """
    given = os.environ.get(VARIABLE)
    if given:
        return given.encode()
    if placement.rank == 0:
        return _hand_out(store, placement.size, timeout)
    found = _read(Path(store.get("token/file").decode()))
    store.add("token/read" if found else "token/lacking", 1)
    store.wait(["token/by store"], timedelta(seconds=timeout))
    by_store = bytes.fromhex(store.get("token/by store").decode())
    return by_store or found


def _hand_out(store: dist.Store, size: int, timeout: float) -> bytes:
    token, path = secrets.token_bytes(_BYTES), None
    for folder in (_cache_folder(), Path(tempfile.gettempdir())):
        path = path or _write(token, folder)
    try:
        store.set("token/file", str(path or ""))
        deadline = time.monotonic() + timeout
        while store.add("token/read", 0) + store.add("token/lacking", 0) < size - 1:
            if time.monotonic() > deadline:
                raise RuntimeError(f"not all of {size} ranks connected within {timeout:g} s")
            time.sleep(_POLL_SECONDS)
    finally:
        if path is not None:
            path.unlink(missing_ok=True)
    lacking = store.add("token/lacking", 0)
    if lacking:
        warnings.warn(
            f"{lacking} ranks see no file of rank 0: the job's token passes through a store that other users of the "
            f"network can read; to prevent this, set {VARIABLE} to the same secret on all ranks",
            stacklevel=2,
        )
    store.set("token/by store", token.hex() if lacking else "")
    return token


def _cache_folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "pgccd"


def _write(token: bytes, folder: Path) -> Path | None:
    """Writes the token to a file that only this user can read; None if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(prefix="token-", dir=folder)  # mode 0600
        with os.fdopen(descriptor, "wb") as file:
            file.write(token)
        return Path(name)
    except OSError:
        return None


def _read(path: Path) -> bytes:
    """The token in such a file; empty if it does not exist or belongs to another user."""
    try:
        with path.open("rb") as file:
            is_own = os.fstat(file.fileno()).st_uid == os.getuid()
            token = file.read(_BYTES + 1)
    except OSError:
        return b""
    return token if is_own and len(token) == _BYTES else b""
