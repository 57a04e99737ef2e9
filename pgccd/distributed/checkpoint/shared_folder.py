"""A folder shared by all ranks and locked against other jobs."""

from __future__ import annotations

import os
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pgccd.checkpoint.lock import hold
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.launch.agreement import on_first, together

# Seconds until a file of one machine is visible on another: network file systems cache directories for seconds.
_SEEN_WITHIN = 20.0


@contextmanager
def hold_together(comm: Comm, folder: Path) -> Iterator[None]:
    """Rank 0 locks the folder against other jobs, and every rank checks that it sees the same folder.

    Raises:
        ValueError: the folder cannot be written to, is locked by another job, or is not visible to a rank; on all
            ranks.
    """
    with ExitStack() as stack:
        on_first(comm, lambda: stack.enter_context(hold(folder)))
        mark = on_first(comm, lambda: write_mark(folder))

        def look() -> None:
            if not sees_mark(folder, mark):
                raise ValueError(
                    f"folder: {folder.absolute()} on {socket.gethostname()} is not that of rank 0, which all must share"
                )

        try:
            together(comm, look)
        finally:
            if comm.rank == 0:
                with suppress(OSError):  # a mark that is left does no harm
                    (folder / mark).unlink(missing_ok=True)
        yield


def write_mark(folder: Path) -> str:
    """Creates a file with a random name; returns the name.

    Raises:
        ValueError: it cannot be created.
    """
    name = f".seen-{secrets.token_hex(8)}"
    try:
        (folder / name).touch()
    except OSError as error:
        raise ValueError(f"folder: cannot write to {folder}: {error.strerror}") from error
    return name


def sees_mark(folder: Path, name: str, within: float = _SEEN_WITHIN) -> bool:
    """Whether the file becomes visible on this machine."""
    deadline = time.monotonic() + within
    while not (folder / name).exists():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
        if folder.is_dir():
            os.listdir(folder)  # makes some network file systems refresh
    return True
