"""Locks folders, so that one job at a time writes to them."""

import fcntl
import os
import socket
import stat
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_LOCK = "lock"
_MOST_HOLDER = 200


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
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        file = open(os.open(folder / _LOCK, flags, 0o666), "r+")  # noqa: SIM115
    except OSError as error:
        at = folder / _LOCK if os.path.lexists(folder / _LOCK) else folder
        raise FolderError(f"folder: cannot write to {at}: {error.strerror or error}") from error
    with file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise FolderError(f"folder: {folder / _LOCK} is no regular file")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = " ".join(file.read(_MOST_HOLDER).split()) or "unknown"
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
