"""A run's folder: held by one job at a time, seen by all its ranks, begun only where nothing would be lost."""

from __future__ import annotations

import fcntl
import json
import os
import secrets
import socket
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pgccd.sim.checkpoint import find_checkpoint, forget_checkpoints

WORLD_FILE = "world.json"
_LOCK = "lock"
# How long a file of one machine may take to be seen by another: network file systems keep what they know for seconds.
_SEEN_WITHIN = 20.0


class FolderError(ValueError):
    """A folder cannot be used for a run; the message says why."""


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Makes the folder if it is missing, and holds it against other jobs.

    Raises:
        FolderError: it cannot be written to, or another job holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(folder / _LOCK, "a+")  # noqa: SIM115  (closed below)
    except OSError as error:
        raise FolderError(f"folder: cannot write to {folder}: {error.strerror or error}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise FolderError(f"folder: {folder} is in use by another job: {holder}") from None
        except OSError as error:  # the file system has no locks
            warnings.warn(f"{folder} cannot be locked against other jobs: {error.strerror}", stacklevel=3)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
        file.flush()
        yield


def begin(folder: Path, world: dict[str, Any], overwrite: bool) -> None:
    """Lets a new run begin in a folder that is held.

    Args:
        folder: of the run.
        world: for `world.json`.
        overwrite: whether a checkpoint of an earlier run may be removed.

    Raises:
        FolderError: there is one, and it may not.
    """
    if not overwrite:
        try:
            earlier = find_checkpoint(folder)
        except ValueError as error:
            problem = f"folder: {folder} holds an earlier run ({error}); overwrite it, or take another"
            raise FolderError(problem) from error
        if earlier is not None:
            made, wanted = earlier.header.steps_made, earlier.header.steps_wanted
            run = f"a run that made {made} of {wanted} steps"
            raise FolderError(f"folder: {folder} holds {run}; resume it, overwrite it, or take another folder")
    forget_checkpoints(folder)
    (folder / WORLD_FILE).write_text(json.dumps(world, indent=2) + "\n")


def write_mark(folder: Path) -> str:
    """Writes a file that only this job knows of; returns its name."""
    name = f".seen-{secrets.token_hex(8)}"
    (folder / name).touch()
    return name


def sees_mark(folder: Path, name: str, within: float = _SEEN_WITHIN) -> bool:
    """Whether the file comes to be seen here."""
    deadline = time.monotonic() + within
    while not (folder / name).exists():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
        if folder.is_dir():
            os.listdir(folder)  # some file systems look again only then
    return True
