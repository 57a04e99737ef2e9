"""Locks folders, so that one job at a time writes to them."""

import fcntl
import os
import socket
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_LOCK = "lock"


class FolderError(ValueError):
    """A folder cannot be used; the message gives the reason."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Creates the folder if needed, and locks it against other jobs.

    Raises:
        FolderError: the folder cannot be written to, or is locked by another job.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Follows no symbolic link.
        file = open(os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), "r+")  # noqa: SIM115
    except OSError as error:
        raise FolderError(f"folder: cannot write to {folder}: {error.strerror or error}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise FolderError(f"folder: {folder} is in use by another job: {holder}") from None
        except OSError as error:  # the file system does not support locks
            warnings.warn(f"{folder} cannot be locked against other jobs: {error.strerror}", stacklevel=3)
        try:
            file.truncate(0)
            os.write(file.fileno(), _holder().encode())
        except OSError as error:
            raise FolderError(f"folder: cannot write to {folder}: {error.strerror or error}") from error
        yield


def _holder() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
